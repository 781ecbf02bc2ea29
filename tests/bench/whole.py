"""A whole scene, from photos and depth maps on disk to refined depth maps on disk, as the command does it.

    python tests/bench/whole.py [--json FILE]       # makes 49 views of 1600 x 1200, then times `pagas-cl refine` twice
    python tests/bench/whole.py --scene FOLDER      # keeps the synthetic scene there, or uses what is there
    python tests/bench/whole.py --effect agreement=off      # options of other names go to the command
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from math import ceil, sqrt
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from record import add_json, record

TITLE = "A whole scene, files to files"
MEASURED = ("Photos and depth maps on disk to refined depth maps on disk, by the command in a process of its own: wall "
            "seconds, seconds of refining, of all work for the views, of the first view.")
ONE_THREAD = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")}


def make(folder: Path, views: int, width: int, height: int) -> None:
    """Photos (JPEG), cameras.json and depth_initial/ of a synthetic relief under a square of cameras.

    Photos are rendered at half size and enlarged: for times alone.
    """
    from support.synthetic import relief_scene
    from support.synthetic.layout import camera_at

    from pagas_cl.scene.readers import camera_file
    from pagas_cl.scene.view import View

    for name in ("images", "depth_initial"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    made, side = relief_scene(width // 2, height // 2, contexts=1, held_out=0), ceil(sqrt(views))
    places = [(k % side - (side - 1) / 2, k // side - (side - 1) / 2) for k in range(views)]
    made = replace(made, cameras=[camera_at(made.relief, f"{k:03d}", 0.6 * right, 0.6 * down)
                                  for k, (right, down) in enumerate(places)])
    with multiprocessing.get_context("fork").Pool(os.cpu_count()) as pool:
        pool.starmap(_make_view, [(made, k, (width, height), folder) for k in range(views)], chunksize=1)
    camera_file.write(folder, [View(c.resized(width, height), Path(f"{c.name}.jpg"), None, f"{c.name}.jpg")
                               for c in made.cameras])


def _make_view(made, k: int, size: tuple[int, int], folder: Path) -> None:
    from PIL import Image

    from pagas_cl.scene.depthmap import save_depth

    camera = made.cameras[k]
    Image.fromarray(made.image(k)).resize(size, Image.BICUBIC).save(folder / "images" / f"{camera.name}.jpg",
                                                                    quality=95)
    save_depth(folder / "depth_initial" / f"{camera.name}.npz", made.initial_depth(camera.resized(*size)))


def arguments(scene: Path, out: Path, more: list[str]) -> list[str]:
    return ["refine", str(scene), "--depth-dir", str(scene / "depth_initial"), "--save-depth", str(out), "--quiet",
            *more]


def timed(scene: Path, out: Path, more: list[str]) -> float:
    """Wall seconds of the command in a process of its own."""
    start = time.perf_counter()
    subprocess.run([sys.executable, "-m", "pagas_cl", *arguments(scene, out, more)], check=True)
    return time.perf_counter() - start


def reported(out: Path) -> dict[str, float]:
    """What the records of the views say: seconds of refining, and of all that a worker did for them."""
    reports = [json.loads(path.read_text())["report"] for path in sorted((out / ".pagas_cl" / "views").glob("*.json"))]
    return {"views": len(reports), "refining": sum(r.get("seconds", 0) for r in reports),
            "at a view": sum(r["task_seconds"] for r in reports), "first view": max(r["task_seconds"] for r in reports)}


def main() -> int:
    parse = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parse.add_argument("--scene", type=Path)
    parse.add_argument("--views", type=int, default=49)
    parse.add_argument("--width", type=int, default=1600)
    parse.add_argument("--height", type=int, default=1200)
    parse.add_argument("--times", type=int, default=2)
    add_json(parse)
    options, more = parse.parse_known_args()
    with tempfile.TemporaryDirectory() as temporary:
        scene = options.scene or Path(temporary) / "scene"
        if not (scene / "cameras.json").exists():
            make(scene, options.views, options.width, options.height)
        rows = []
        for number in range(options.times):
            out = Path(temporary) / f"out{number}"
            seconds = timed(scene, out, more)
            rows.append({"run": f"{number + 1} {' '.join(more)}".strip(), "seconds": seconds, **reported(out)})
    from pagas_cl.runtime.device import open_device

    record(TITLE, MEASURED, open_device(None).info.title, rows, options.json)
    return 0


if __name__ == "__main__":
    os.environ.update(ONE_THREAD)
    sys.exit(main())
