"""What the rounds of agreement take beside the refinement: seconds by the clock and of the processor, with nothing
but the core installed.

    python tests/bench/agreement_time.py [--sizes 777x581 1554x1162] [--views 12] [--device NAME]

A made scene: a few views to compile everything, then view by view, and then in the rounds; --profile: the host's part
of these by function.
"""

import argparse
import cProfile
import pstats
import time

import numpy as np

from pagas_cl.presets import BALANCED
from pagas_cl.refine import refine_views
from pagas_cl.rounds import later_rounds
from pagas_cl.runtime.device import open_device
from pagas_cl.scene.choice import PartnerChooser
from pagas_cl.splat import PhotoStore
from pagas_cl.synthetic import relief_scene


def seconds(width: int, height: int, number: int, config, device, profile):
    """Views by themselves, and rounds: seconds by the clock and of the processor; `profile` is of the rounds."""
    made = relief_scene(width, height, number - 1, held_out=0)
    views, depths = made.all_views, [made.initial_depth(camera) for camera in made.cameras]
    alone = config.with_settings(effects__agreement="off", effects__cameras="off")
    refine_views(views[:3], depths[:3], device=device,
                 config=config.with_settings(effects__agreement="on", effects__cameras="off"))
    start = now()
    results = refine_views(views, depths, config=alone, device=device)
    found = [now() - start]
    chooser, photos = PartnerChooser(made.cameras, depths, config.context), PhotoStore(device)
    partners = [chooser.choose(k) for k in range(len(views))]
    for view in views:          # as the rounds find them, which follow the views by themselves
        photos.photo(view)
    start = now()
    if profile:
        profile.enable()
    for step in later_rounds(config, len(views)):
        before = dict(enumerate(results))
        results = [step.work(views, partner, [before[k] for k in partner.refined(before)], config, device, photos)
                   for partner in partners]
    if profile:
        profile.disable()
    return [*found, now() - start]


def now() -> np.ndarray:
    return np.array([time.perf_counter(), time.process_time()])


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", nargs="*", default=["777x581", "1554x1162"])
    parser.add_argument("--views", type=int, default=12)
    parser.add_argument("--steps", type=int, default=180)
    parser.add_argument("--profile", action="store_true")
    parser.add_argument("--device", default=None)
    given = parser.parse_args()
    device, config = open_device(given.device), BALANCED.with_settings(pyramid__steps=(given.steps,))
    for size in given.sizes:
        profile = cProfile.Profile() if given.profile else None
        alone, rounds = seconds(*map(int, size.split("x")), given.views, config, device, profile)
        print(f"{device.info.title}, {given.views} views of {size}: {alone[0]:.2f} s, rounds {rounds[0]:.2f} s, "
              f"{rounds[0] / alone[0]:.0%}; of the processor {alone[1]:.2f} s, {rounds[1]:.2f} s, "
              f"{rounds[1] / alone[1]:.0%}", flush=True)
        if profile:
            pstats.Stats(profile).sort_stats("tottime").print_stats(25)


if __name__ == "__main__":
    main()
