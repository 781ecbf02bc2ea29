"""Synthetic scenes that each need one effect: error and time with the effect off, decided by measurement, and
all on.

    python tests/bench/effects.py [--width 288] [--device NAME] [--json FILE]

Errors are means over the target's pixels, in pixels of parallax, and of normals in degrees;
times are the best of three runs.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from bench.record import add_json, record
from support.scenes import mixed_scene

from pagas_cl.app.evaluate.depth import compare_depth
from pagas_cl.config import Effects
from pagas_cl.config.presets import BALANCED
from pagas_cl.method.splat import PhotoStore
from pagas_cl.method.view.one_view import refine_depth
from pagas_cl.runtime.device import open_device

TITLE = "Effects: off, decided by measurement, all on"
MEASURED = ("Synthetic scenes that each need one effect, preset `balanced`: mean depth error in pixels of parallax and "
            "mean angle of normals over the target; seconds of a view, least of three.")

# scene: its settings, the effect that it needs, and effects that it may have as well
SCENES = {
    "clean": (dict(steps=0), None, ()),
    "exposure jitter": (dict(steps=0, exposure=0.3), "exposure", ()),
    "occluder in front": (dict(bar=8.0), "occlusion", ()),
    "foreground mask": (dict(steps=0, foreground=True), "masks", ("occlusion",)),
    "shiny surface": (dict(steps=0, shine=0.5), "view_dependence", ("exposure",)),
    "little texture, noise": (dict(steps=0, contrast=0.25, noise=6.0), "noise", ()),
    "mixed distances": (dict(steps=0, distances=(1.0, 2.5, 1.6), sizes=(1.0, 0.6)), "antialiasing", ()),
    "coarse initial depth": (dict(steps=0, coarse_error=3.0), "pyramid", ()),
}


def without_mask(views):
    return [replace(view, mask=None) for view in views]


def run(made, views, config, device):
    """Depth, seconds of the refinement, and the decisions, for the target of a synthetic scene."""
    photos, depth = PhotoStore(device), made.initial_depth(made.cameras[0])
    if made.relief.foreground:
        depth = bloated(depth, 12)
    target, *contexts = views
    best = np.inf
    for _ in range(3):
        start = time.perf_counter()
        result = refine_depth(target, contexts, depth, config=config, device=device, photos=photos)
        best = min(best, time.perf_counter() - start)
    return result.depth, best, {effect["effect"]: effect["on"] for effect in result.report["effects"]}


def bloated(depth, pixels):
    """The depth map grown beyond its outline, as the mesh of a reconstructor is that knows no mask."""
    for _ in range(pixels):
        padded = np.pad(depth, 1, mode="edge")
        around = np.stack([padded[1:-1, :-2], padded[1:-1, 2:], padded[:-2, 1:-1], padded[2:, 1:-1]])
        depth = np.where(depth > 0, depth, around.max(axis=0))
    return depth


def errors(made, depth):
    report = compare_depth(depth, made.true_depth(made.cameras[0]), made.cameras[0], parallax=made.relief.parallax,
                           true_normals=made.true_normals(made.cameras[0]))
    return report.all.mean_parallax, report.all.normal_mean


def row(name, width, contexts, device, config):
    settings, effect, _ = SCENES[name]
    made = mixed_scene(width, width * 3 // 4, contexts, held_out=0, **settings)
    auto = run(made, made.views, config, device)
    forced = config if effect in (None, "masks") else config.with_settings(**{f"effects__{effect}": "off"})
    off = run(made, without_mask(made.views) if effect == "masks" else made.views, forced, device)
    every = run(made, made.views, replace(config, effects=Effects.every("on")), device)
    found = [made.initial_depth(made.cameras[0]), *(depth for depth, _, _ in (off, auto, every))]
    shown = [f"{depth:.3f} px, {angle:.1f}°" for depth, angle in (errors(made, each) for each in found)]
    enabled = [effect for effect, on in auto[2].items() if on]
    return {"scene": name, "effect that it needs": effect or "none", "`auto` enables": ", ".join(enabled),
            **dict(zip(("input", "effect off", "auto", "all on"), shown)),
            "s: off / auto / all on": " / ".join(f"{seconds:.3f}" for _, seconds, _ in (off, auto, every))}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--width", type=int, default=288)
    parser.add_argument("--contexts", type=int, default=5)
    parser.add_argument("--device", default=None)
    parser.add_argument("--scenes", nargs="*", default=list(SCENES))
    add_json(parser)
    given = parser.parse_args()
    device = open_device(given.device)
    rows = [row(name, given.width, given.contexts, device, BALANCED) for name in given.scenes]
    record(TITLE, MEASURED, device.info.title, rows, given.json)


if __name__ == "__main__":
    main()
