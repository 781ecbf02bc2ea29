"""Time of one view's gradient when N Gaussians fall into one pixel, beside the same Gaussians spread over the image.

    python tests/bench/crowded.py [most]          # N = 100 ... most (1e6) on the device PAGAS_CL_DEVICE names

Bounded means: N times the Gaussians take about N times as long, never N squared. Three ways to crowd: `far`, the
context camera is so far that the whole target is less than one of its pixels; `ray`, every depth is chosen so that the
target's pixels of a row meet on one ray of the context camera, seen by it as one pixel; `scattered`, for comparison.
"""

from __future__ import annotations

import sys
import time

import numpy as np

from pagas_cl.app.selftest import BLENDS
from pagas_cl.app.selftest import scenes as make
from pagas_cl.method.splat.view import full_level
from pagas_cl.runtime.device import open_device
from pagas_cl.scene.view import View

ROUNDS, LONGEST = 2, 15.0      # seconds that one run may be expected to take


def far(side: int) -> make.HardScene:
    """All of the target within half a pixel of the context photo, in one bin."""
    scene = make.base(size=(side, side), centers=((0.0, 0.0, -90.0),), rotations=[make.turn()])
    camera = make.camera((33, 33), (50.0, 50.0), (0.0, 0.0, -90.0), principal=(16.5, 16.5))
    return make.HardScene(scene.target, [View(camera, make.photo(np.random.default_rng(0), (33, 33)))], scene.depth)


def ray(side: int) -> make.HardScene:
    """Every row of the target meets on the plane x = 0.5: a context camera at (0.5, 0, 0) that looks along z sees a
    row as one pixel, and all rows as one column that its short focal length makes one bin high."""
    scene = make.base(size=(side, side), centers=((0.5, 0.0, 0.0),), rotations=[make.turn()])
    rays = scene.target.camera.rays()[..., 0]
    depth = np.where(rays > 0.02, 0.5 / np.maximum(rays, 0.02), 0)
    camera = make.camera((33, 33), (0.4, 0.4), (0.5, 0.0, 0.0), principal=(16.5, 16.5))
    return make.HardScene(scene.target, [View(camera, make.photo(np.random.default_rng(0), (33, 33)))], depth)


def scattered(side: int) -> make.HardScene:
    return make.base(size=(side, side), centers=((0.1, 0.0, 0.0),), rotations=[make.turn(y=0.1)])


def seconds(scene: make.HardScene, config, device) -> float:
    """Least of some rounds of one view's launches."""
    level, best = full_level(scene.target, scene.contexts, scene.depth, config, device), np.inf
    for _ in range(1 + ROUNDS):
        device.queue.finish()
        start = time.perf_counter()
        for launch in level.launches_of(0):
            launch.enqueue(device.queue)
        device.queue.finish()
        best = min(best, time.perf_counter() - start)
    level.release()
    return best


def main() -> None:
    most, device = float(sys.argv[1]) if len(sys.argv) > 1 else 1e6, open_device()
    print(f"{device.info}\n\n| blend | Gaussians | far, ms | ray, ms | scattered, ms |\n|---|---|---|---|---|")
    for blend, config in BLENDS.items():
        config = config.with_settings(pyramid__scales=(1.0,), pyramid__steps=(1,))
        last = 0.0
        for number in (1e2, 1e3, 1e4, 1e5, 1e6):
            if number <= most and 10 * last < LONGEST:
                side = round(number**0.5)
                found = [seconds(scene(side), config, device) for scene in (far, ray, scattered)]
                last = max(found)
                print(f"| {blend} | {side * side} | {' | '.join(f'{1e3 * t:.2f}' for t in found)} |", flush=True)


if __name__ == "__main__":
    main()
