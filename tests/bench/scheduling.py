"""How many views a second the run itself can hand out and take back: work that copies the depth, on tiny images.

    python tests/bench/scheduling.py --views 1000 --workers 8      # needs pagas-cl[cluster]

What is counted is planning, hashing, the scheduler, journals, records and files; a view's refinement is not.
"""

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from distributed import Client, LocalCluster
from PIL import Image
from record import add_json, record

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from conftest import look_at
from support.job_scenes import QUICK, copy_depth

from pagas_cl.jobs import refine_all
from pagas_cl.scene.view import View

TITLE = "Many views: handing out"
MEASURED = ("Plan, hand out, take back and write, for work that copies a tiny depth map; scheduler and workers on the "
            "same cores.")


def ring(folder: Path, count: int):
    """Views of 32 x 24 pixels on a circle, each with a photo file of its own, and flat depth maps."""
    views, rng = [], np.random.default_rng(0)
    for k, angle in enumerate(np.linspace(0, 2 * np.pi, count, endpoint=False)):
        path = folder / f"{k:06d}.png"
        Image.fromarray(rng.integers(0, 255, (24, 32, 3), np.uint8)).save(path)
        place = 4 * np.sin(angle), 0.5, -4 * np.cos(angle)
        camera = look_at(place, (0, 0, 0), 32, 24, 30.0, 16.0, 12.0, name=path.name)
        views.append(View(camera, path, None, path.name))
    return views, [np.full((24, 32), 4, np.float32)] * count


def runs(folder: Path, count: int, workers: int) -> list[dict]:
    """A row for a first run of so many views, and one for the same run again."""
    views, depths = ring(folder, count)
    rows = []
    with LocalCluster(n_workers=workers, threads_per_worker=1, processes=False,
                      dashboard_address=None) as cluster, Client(cluster, set_as_default=False) as client:
        for name in ("first", "all is finished"):
            start = time.perf_counter()
            refine_all(copy_depth, views, depths, range(count), QUICK, folder=folder / "out", extras=False,
                       executor=client.get_executor(pure=False))
            taken = time.perf_counter() - start
            rows.append({"run": name, "views": count, "s": taken, "ms per view": 1000 * taken / count})
    return rows


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--views", type=int, default=1000)
    parser.add_argument("--workers", type=int, default=8)
    add_json(parser)
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        rows = runs(Path(folder), chosen.views, chosen.workers)
    record(TITLE, MEASURED, f"{os.cpu_count()} CPU cores", rows, chosen.json)


if __name__ == "__main__":
    main()
