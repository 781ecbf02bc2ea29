"""Photos that do not show what the target's does, among those that a view is refined by: errors with the effect
`resemblance` off and auto, in one run.

    python tests/bench/resemblance.py [--width 160] [--cases clean blurred ...] [--device NAME]

A made relief, 12 other views, 10 asked for: clean, or three of the photos blurred (3 pixels), shifted by a quarter of
their width (as if of something else), or their cameras off by (3, -3) pixels; wide: neighbours 16 degrees apart, seen
from aside, so that views look from up to 49 degrees; wide, shiny: the same with a moving highlight; wide, gain: with
brightness that differs from place to place. Depth in pixels of parallax, normals in degrees, away from edges.
"""

import argparse
import time
from dataclasses import replace

import numpy as np
from agreement import eight_bit, gain
from PIL import Image, ImageFilter

from pagas_cl.app.evaluate import compare_depth
from pagas_cl.app.synthetic import relief_scene
from pagas_cl.config.presets import BALANCED
from pagas_cl.method.splat import PhotoStore
from pagas_cl.method.view.one_view import refine_one
from pagas_cl.runtime.device import open_device
from pagas_cl.scene.choice import PartnerChooser

SPOILED, ASIDE = (2, 5, 7), 9       # of the views; the one in `wide` that is refined


def _blurred(view):
    return replace(view, image=np.asarray(Image.fromarray(view.load_image()).filter(ImageFilter.GaussianBlur(3))))


def _elsewhere(view):
    return replace(view, image=np.roll(view.load_image(), view.camera.width // 4, axis=1))


def _off(view):
    return replace(view, camera=replace(view.camera, cx=view.camera.cx + 3, cy=view.camera.cy - 3))


SPOIL = {"clean": lambda view: view, "blurred": _blurred, "elsewhere": _elsewhere, "off": _off}


def scene_of(case: str, width: int):
    """Synthetic scene, its views, and which of them is refined."""
    wide = case.startswith("wide")
    made = relief_scene(width, width * 3 // 4, 12, held_out=0, detail=0.4, spacing=16 if wide else 11,
                        shine=0.6 if "shiny" in case else 0.0)
    views = made.all_views
    if "gain" in case:
        views = [replace(view, image=eight_bit(gain(np.random.default_rng(k), view.load_image() / 255)))
                 for k, view in enumerate(views)]
    spoil = SPOIL.get(case, SPOIL["clean"])
    return made, [spoil(view) if k in SPOILED else view for k, view in enumerate(views)], ASIDE if wide else 0


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--width", type=int, default=160)
    parser.add_argument("--cases", nargs="*", default=[*SPOIL, "wide", "wide, shiny", "wide, gain"])
    parser.add_argument("--device")
    given = parser.parse_args()
    device = open_device(given.device)
    print("| photos | effect | not asked | depth, normals | rejected | seconds of the processor |", "|---" * 6 + "|",
          sep="\n")
    for case in given.cases:
        made, views, target = scene_of(case, given.width)
        camera, depths = made.cameras[target], [made.initial_depth(camera) for camera in made.cameras]
        for choice in ("off", "auto"):
            config = BALANCED.with_settings(effects__resemblance=choice)
            partners = PartnerChooser([view.camera for view in views], depths, config.context).choose(target)
            start = time.process_time()
            result = refine_one(views, partners, depths[target], config, device, PhotoStore(device))
            seconds = time.process_time() - start
            found = compare_depth(result.depth, made.true_depth(camera), camera, parallax=made.relief.parallax,
                                  true_normals=made.true_normals(camera)).smooth
            left_out = len(partners.all) - 1 - len(result.report["contexts"]) - len(result.report["held_out"])
            share = result.counts["rejected"] / max(1, result.counts["rejected"] + result.counts["refined"])
            rejected = "all" if result.reason else f"{share:.1%}"
            print(f"| {case} | {choice} | {left_out} of {len(partners.all) - 1} | {found.mean_parallax:.3f}, "
                  f"{found.normal_mean:.1f}° | {rejected} | {seconds:.2f} |", flush=True)


if __name__ == "__main__":
    main()
