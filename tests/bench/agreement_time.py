"""Price of the rounds of agreement: seconds of refine_views without them and with them, alternating.

    python tests/bench/agreement_time.py [--sizes 777x581 1554x1162] [--views 12] [--repeats 5] [--device NAME]

A made scene, whose photos are rendered at a quarter of 1554 x 1162 and enlarged: for times alone. Of each kind of run
the median.
"""

import argparse
import multiprocessing
import sys
import time
from pathlib import Path
from statistics import median

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from PIL import Image
from record import add_json, record
from support.synthetic import relief_scene

from pagas_cl.config.presets import BALANCED
from pagas_cl.refine import refine_views
from pagas_cl.runtime.device import open_device
from pagas_cl.scene.view import View

TITLE = "Rounds of agreement: price"
MEASURED = ("Seconds of `refine_views` for a synthetic scene without and with the rounds, cameras not refined, medians "
            "of alternating runs.")
CONFIG = BALANCED.with_settings(effects__cameras="off")
KINDS = {choice: CONFIG.with_settings(effects__agreement=choice) for choice in ("off", "on")}


def render(number: int, width: int):
    """Cameras and photos of so many views, and what draws their depth maps."""
    made = relief_scene(width, round(width * 290 / 388), number - 1, held_out=0)
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
    parser.add_argument("--repeats", type=int, default=5)
    add_json(parser)
    parser.add_argument("--device", default=None)
    given = parser.parse_args()
    made, photos = render(given.views, min(388, max(int(size.split("x")[0]) for size in given.sizes)))
    scenes = {size: at_size(made, photos, *map(int, size.split("x"))) for size in given.sizes}   # before a device opens
    device = open_device(given.device)
    rows = []
    for size, scene in scenes.items():
        refine_views(*(part[:3] for part in scene), config=KINDS["on"], device=device)           # compiles
        pairs = [[seconds(*scene, config, device) for config in KINDS.values()] for _ in range(given.repeats)]
        for clock, name in enumerate(("wall", "processor")):
            alone, both = (median(pair[kind][clock] for pair in pairs) for kind in (0, 1))
            rows.append({"size": size, "views": given.views, "clock": name, "without, s": alone, "with, s": both,
                         "more": f"{both / alone - 1:.0%}"})
    record(TITLE, MEASURED, device.info.title, rows, given.json)


if __name__ == "__main__":
    main()
