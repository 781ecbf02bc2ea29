"""Synthetic scenes that each call for one effect: error and time with the effect off, decided by measurement, and
all on.

    python tests/bench/effects.py [--width 288] [--device NAME] [--out FILE.md]

Errors are means over the target's pixels, in pixels of parallax, and of normals in degrees;
times are those of the steps alone, the best of three runs.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import numpy as np

from pagas_cl.app.evaluate import compare_depth
from pagas_cl.app.synthetic import relief_scene
from pagas_cl.config import Effects
from pagas_cl.config.presets import BALANCED
from pagas_cl.method.effects.decide import EFFECTS, decide
from pagas_cl.method.effects.measure import measure
from pagas_cl.method.splat import PhotoStore, refine_levels
from pagas_cl.runtime.device import open_device

# scene: its settings, the effect that it calls for, and effects that it may have beside it
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
    """Depth, seconds of the steps, and the decisions, for the target of a synthetic scene."""
    photos, depth = PhotoStore(device), made.initial_depth(made.cameras[0])
    if made.relief.foreground:
        depth = bloated(depth, 12)
    target, *contexts = views
    measured = measure(target, contexts, depth, config, device, photos)
    config, decisions = decide(config, measured)
    best = np.inf
    for _ in range(3):
        start = time.perf_counter()
        refined = refine_levels(target, contexts, depth, config, device, photos, measured=measured)
        best = min(best, time.perf_counter() - start)
    return refined.depth, best, {d.effect: d for d in decisions}


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
    made = relief_scene(width, width * 3 // 4, contexts, held_out=0, **settings)
    auto = run(made, made.views, config, device)
    forced = config if effect in (None, "masks") else config.with_settings(**{f"effects__{effect}": "off"})
    off = run(made, without_mask(made.views) if effect == "masks" else made.views, forced, device)
    every = run(made, made.views, replace(config, effects=Effects.every("on")), device)
    cells = [errors(made, made.initial_depth(made.cameras[0]))] + [errors(made, r[0]) for r in (off, auto, every)]
    picked = [e for e in EFFECTS if e in auto[2] and auto[2][e].on]
    return name, effect or "none", ", ".join(picked), cells, [r[1] for r in (off, auto, every)], auto[2]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--width", type=int, default=288)
    parser.add_argument("--contexts", type=int, default=5)
    parser.add_argument("--device", default=None)
    parser.add_argument("--scenes", nargs="*", default=list(SCENES))
    parser.add_argument("--out", default=None)
    given = parser.parse_args()
    device = open_device(given.device)
    lines = ["| scene | calls for | `auto` switches on | initial | effect off | auto | all on | "
             "time off / auto / all on, s |",
             "|---|---|---|---|---|---|---|---|"]
    print(device.info, flush=True)
    for name in given.scenes:
        name, effect, picked, cells, times, decisions = row(name, given.width, given.contexts, device, BALANCED)
        cells = " | ".join(f"{d:.3f} px, {n:.1f}°" for d, n in cells)
        lines.append(f"| {name} | {effect} | {picked} | {cells} | {' / '.join(f'{t:.3f}' for t in times)} |")
        print(lines[-1], flush=True)
        print("   ", {k: round(d.evidence, 4) for k, d in decisions.items()}, flush=True)
    if given.out:
        with open(given.out, "w") as file:
            file.write("\n".join([f"Measured on {device.info}, {given.width} x {given.width * 3 // 4} pixels, "
                                  f"{given.contexts} context views, preset `balanced`.", "", *lines, ""]))


if __name__ == "__main__":
    main()
