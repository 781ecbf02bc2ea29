"""What the rounds of agreement take beside the refinement, with nothing but the core installed: seconds of refine_views
without them and with them, in turns.

    python tests/bench/agreement_time.py [--sizes 777x581 1554x1162] [--views 12] [--turns 5] [--device NAME]

A made scene, whose photos are rendered at a quarter of 1554 x 1162 and enlarged: for times alone. Of each kind of run
the median; --profile: the host's part of one with the rounds, by function.
"""

import argparse
import cProfile
import multiprocessing
import pstats
import time
from statistics import median

import numpy as np
from PIL import Image

from pagas_cl.app.synthetic import relief_scene
from pagas_cl.config.presets import BALANCED
from pagas_cl.refine import refine_views
from pagas_cl.runtime.device import open_device
from pagas_cl.scene.view import View

CONFIG = BALANCED.with_settings(effects__cameras="off")
KINDS = {choice: CONFIG.with_settings(effects__agreement=choice) for choice in ("off", "on")}


def render(number: int):
    """Cameras and photos of so many views, and what draws their depth maps."""
    made = relief_scene(388, 290, number - 1, held_out=0)
    with multiprocessing.get_context("fork").Pool() as pool:
        return made, pool.map(made.image, range(number))


def at_size(made, photos, width: int, height: int):
    """Views and depth maps."""
    cameras = [camera.resized(width, height) for camera in made.cameras]
    views = [View(camera, np.asarray(Image.fromarray(photo).resize((width, height), Image.Resampling.BICUBIC)))
             for camera, photo in zip(cameras, photos)]
    with multiprocessing.get_context("fork").Pool() as pool:
        return views, pool.map(made.initial_depth, cameras)


def seconds(views, depths, config, device) -> np.ndarray:
    """By the clock, of the processor."""
    start = np.array([time.perf_counter(), time.process_time()])
    refine_views(views, depths, config=config, device=device)
    return np.array([time.perf_counter(), time.process_time()]) - start


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", nargs="*", default=["777x581", "1554x1162"])
    parser.add_argument("--views", type=int, default=12)
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--profile", action="store_true")
    parser.add_argument("--device", default=None)
    given = parser.parse_args()
    made, photos = render(given.views)
    scenes = {size: at_size(made, photos, *map(int, size.split("x"))) for size in given.sizes}   # before a device opens
    device = open_device(given.device)
    for size, scene in scenes.items():
        refine_views(*(part[:3] for part in scene), config=KINDS["on"], device=device)           # compiles
        turns = [[seconds(*scene, config, device) for config in KINDS.values()] for _ in range(given.turns)]
        print(f"{device.info.title}, {given.views} views of {size}:", end=" ")
        for what, clock in (("s by the clock", 0), ("s of the processor", 1)):
            alone, both = (median(turn[kind][clock] for turn in turns) for kind in (0, 1))
            print(f"{alone:.2f}, with the rounds {both:.2f} {what}, {both / alone - 1:.0%} more", end="; ")
        print(flush=True)
        if given.profile:
            profile = cProfile.Profile()
            profile.runcall(seconds, *scene, KINDS["on"], device)
            pstats.Stats(profile).sort_stats("tottime").print_stats(25)


if __name__ == "__main__":
    main()
