"""How many views a second the run itself can hand out and take back: work that copies the depth, on tiny images.

    python tests/bench/scheduling.py --views 1000 --workers 8      # needs pagas-cl[cluster]

What is counted is planning, hashing, the scheduler, journals, records and files; a view's refinement is not.
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from distributed import Client, LocalCluster
from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from conftest import look_at
from support.job_scenes import QUICK, copy_depth

from pagas_cl.app.jobs import refine_all
from pagas_cl.scene.view import View


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


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--views", type=int, default=1000)
    parser.add_argument("--workers", type=int, default=8)
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        views, depths = ring(Path(folder), chosen.views)
        with LocalCluster(n_workers=chosen.workers, threads_per_worker=1, processes=False,
                          dashboard_address=None) as cluster, Client(cluster, set_as_default=False) as client:
            for name in ("first run", "again, all finished"):
                start = time.perf_counter()
                refine_all(copy_depth, views, depths, range(len(views)), QUICK, folder=Path(folder) / "out",
                           extras=False, executor=client.get_executor(pure=False))
                taken = time.perf_counter() - start
                sys.stdout.write(f"{name}: {taken:.2f} s, {1000 * taken / len(views):.2f} ms a view\n")


if __name__ == "__main__":
    main()
