"""What refining cameras takes, beside refining the views: seconds, and how they grow with pixels, pairs and views.

    python tests/bench/camera_cost.py [--width 1554] [--views 12] [--device NAME]

Needs NumPy, pyopencl and Pillow alone. A made relief is photographed once, by as many processes as there are cores, and
made smaller; cameras are off by half a pixel. Every time is that of a second run, with all kernels compiled.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from support.camera_noise import noisy

_SCENES: list = []


def photographed(k: int):
    scene = _SCENES[0]
    return scene.image(k), scene.initial_depth(scene.cameras[k])


def made(width: int, views: int):
    """Cameras, photos and initial depth maps."""
    from pagas_cl.app.synthetic import relief_scene

    _SCENES.append(relief_scene(width, round(width * 1162 / 1554), views - 1, held_out=0))
    with multiprocessing.get_context("fork").Pool() as pool:
        found = pool.map(photographed, range(views), 1)
    return _SCENES[0].cameras, [photo for photo, _ in found], [depth for _, depth in found]


def smaller(cameras, photos, depths, share: float):
    """Views with cameras that are off, and depth maps, at a share of the size."""
    from pagas_cl.scene.depthmap import resize_depth
    from pagas_cl.scene.images import photo_to
    from pagas_cl.scene.view import View

    sizes = [(round(camera.width * share), round(camera.height * share)) for camera in cameras]
    small = noisy([camera.resized(*size) for camera, size in zip(cameras, sizes)], 0.5, 0)
    return ([View(camera, photo_to(photo, *size), name=camera.name) for camera, photo, size in
             zip(small, photos, sizes)], [resize_depth(depth, *size) for depth, size in zip(depths, sizes)])


def timed(work):
    """What `work` gives, and the seconds of its second run."""
    work()
    start = time.perf_counter()
    found = work()
    return found, time.perf_counter() - start


def exponent(sizes, seconds) -> float:
    return float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0])


def main() -> int:
    parse = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parse.add_argument("--width", type=int, default=1554)
    parse.add_argument("--views", type=int, default=12)
    parse.add_argument("--device")
    ask = parse.parse_args()
    start = time.perf_counter()
    scene = made(ask.width, ask.views)
    print(f"photographed in {time.perf_counter() - start:.0f} s", flush=True)
    from pagas_cl.config.presets import preset
    from pagas_cl.method.cameras.refine import refine_cameras
    from pagas_cl.refine import refine_views
    from pagas_cl.runtime.device import open_device

    device, balanced = open_device(ask.device), preset("balanced")
    print(device.info.title, flush=True)

    def adjusted(share: float = 1.0, pairs: int = 6, views: int = ask.views):
        chosen, depths = smaller(*(part[:views] for part in scene), share)
        config = balanced.with_settings(context__number=pairs)
        found, seconds = timed(lambda: refine_cameras(chosen, depths, config=config, device=device))
        rounds = [row for row in found.report["rounds"] if "step" in row]
        print(json.dumps({"share": share, "contexts": pairs, "views": views, "seconds": round(seconds, 3), "accepted":
                          found.accepted, "coarse": found.report["coarse"], "rounds": len(rounds), "full size":
                          sum(row["share"] == max(r["share"] for r in rounds) for row in rounds)}), flush=True)
        return seconds

    shares, numbers, counts = (0.25, 0.5, 1.0), (2, 4, 6), sorted({max(5, ask.views // 2), ask.views})
    by_size = [adjusted(share) for share in shares]
    by_pairs = [adjusted(pairs=pairs) for pairs in numbers[:-1]] + by_size[-1:]
    by_views = [adjusted(views=views) for views in counts[:-1]] + by_size[-1:]
    print(f"exponents: pixels {exponent(np.square(shares), by_size):.2f}, pairs {exponent(numbers, by_pairs):.2f}, "
          f"views {exponent(counts, by_views):.2f}", flush=True)
    views, depths = smaller(*scene, 1.0)
    views = [replace(view, camera=camera) for view, camera in zip(views, scene[0])]        # refined as good ones are
    for words, agreement in (("refined with balanced", "auto"), ("without agreement", "off")):
        config = balanced.with_settings(effects__cameras="off", effects__agreement=agreement)
        _, seconds = timed(lambda: refine_views(views, depths, config=config, device=device))
        print(f"{ask.views} views {words}: {seconds:.2f} s; cameras: {by_size[-1]:.2f} s", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
