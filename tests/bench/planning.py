"""Time and memory of planning a run of many views, all simulated: cameras over a hilly ground, depth maps sampled.

    python tests/bench/planning.py --views 10000
"""

import argparse
import os
import pickle
import resource
import time
from pathlib import Path

import numpy as np
from record import add_json, record

from pagas_cl.config.presets import preset
from pagas_cl.jobs.plan import Batch, Planner, groups
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.sampling import DepthSample, sample_depth
from pagas_cl.scene.view import View

TITLE = "Many views: planning"
MEASURED = ("Planning a run of many views over hilly ground, for one process.")


class Known:
    """Stands for a photo or a depth map on disk whose hash is known: reading files is not what is measured."""

    def __init__(self, digest: str):
        self.digest = digest

    def load(self):
        raise RuntimeError("planning reads no photo and no whole depth map")


def make_views(count: int):
    """Views of 1554 x 1162 pixels in a block of flight lines, 80% overlap, and samples of their depth maps."""
    rng, views, samples = np.random.default_rng(0), [], []
    side, height, focal = int(np.ceil(np.sqrt(count))), 100.0, 1400.0
    step = 0.2 * height * 1554 / focal
    columns, rows = np.meshgrid((np.arange(0, 1554, 8) + 0.5 - 777) / focal,
                                (np.arange(0, 1162, 8) + 0.5 - 581) / focal)
    for number in range(count):
        x, y = step * (number % side), step * (number // side)
        ground = 5 * np.sin((x + columns * height) / 60) * np.cos((y + rows * height) / 45)
        depth = (height - ground).astype(np.float32)
        pose = np.eye(4)
        pose[:3, 3] = -np.array([x, y, -height]) - rng.normal(0, 0.5, 3)
        camera = Camera(1554, 1162, focal, focal, 777, 581, pose, f"{number:06d}.jpg")
        small = sample_depth(depth)
        farthest = np.full((47, 63), small.farthest.max(), np.float32)  # the grid that photos of this size have
        samples.append(DepthSample(small.rows * 8, small.columns * 8, small.depth, farthest, (1162, 1554), 25))
        views.append(View(camera, Known(f"{number}"), None, camera.name))
    return views, samples


def peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def plan_all(count: int, workers: int) -> dict:
    """Figures of planning `count` views for so many workers."""
    before = peak_mb()
    views, samples = make_views(count)
    made, start = peak_mb(), time.perf_counter()
    planner = Planner(views, [Known(f"d{k}") for k in range(count)], samples, preset("balanced"), make_views)
    parts = groups(list(range(count)), views, workers)
    first, contexts, sent, used = None, 0, [], time.process_time()
    template = Batch(make_views, {}, {}, (), preset("balanced"), Path("."))
    for part in parts:
        tasks = [planner.task(k) for k in part]
        batch = planner.batch(tasks, template)
        first = first or time.perf_counter() - start
        contexts += sum(len(task.partners.contexts) for task in tasks)
        sent.append((len(batch.views), len(tasks), len(pickle.dumps(batch))))
    needed, targets, size = np.sum(sent, axis=0)
    return {"views": count, "workers": workers, "seconds": time.perf_counter() - start,
            "processor time, s": time.process_time() - used, "first batch after, s": first,
            "batches": len(parts), "context views, per view": contexts / count,
            "photos of a batch, per view": needed / targets, "sent to a worker, kB per view": size / count / 1000,
            "samples and cameras, MB": made - before,
            "more for planning, MB": peak_mb() - made}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--views", type=int, default=10_000)
    parser.add_argument("--workers", type=int, default=64)
    add_json(parser)
    chosen = parser.parse_args()
    rows = [{"figure": name, "value": value} for name, value in plan_all(chosen.views, chosen.workers).items()]
    record(TITLE, MEASURED, f"{os.cpu_count()} CPU cores", rows, chosen.json)


if __name__ == "__main__":
    main()
