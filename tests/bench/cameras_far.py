"""Cameras that are far off: how many are accepted, and what is left of it. No scene may be accepted that stays far off.

    python tests/bench/cameras_far.py [--json FILE] [--width 160] [--amounts 0.5 ...] [--seeds 0 1 2] [--depth good]

A made scene (seven views, photos of 160 x 120), cameras rotated and moved at random by the pixels given; depth as the
coarse surface has it ("good"), or as a network leaves it (a factor and a shift a view, errors, holes), aligned in scale
under these cameras. Pixels left: what true matches are off by when each point takes the depth that suits all photos
(what photos can see), and by which photos move to the true cameras after a similarity (what depth then is off by is
bent, tilted or shifted, too). Whole photos are measured only where coarse ones do not find
together (else 0.0).
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from bench.record import add_json, record
from support.camera_noise import after_similarity, noisy, rms_motion, unexplained

TITLE = "Cameras that are far off"
MEASURED = ("How many draws are accepted and what is left in pixels (median; the worst of those accepted), synthetic "
            "relief, photos of 160 x 120 by default; `network`: depth with a factor and a shift in each view, errors "
            "and holes.")
AMOUNTS = (0.5, 1.0, 3.0, 6.0, 8.0, 10.0, 14.0, 20.0, 30.0)


def far(kind: str, pixels: float, seed: int, width: int = 160, contexts: int = 6, **settings) -> dict:
    """One refinement: what it was given, what it did, what is left."""
    from support.example_scenes import METRES, as_network, frames_of
    from support.synthetic import relief_scene

    from pagas_cl.config import Context
    from pagas_cl.method.cameras.pairs import choose_pairs
    from pagas_cl.method.cameras.refine import refine_cameras
    from pagas_cl.method.surface.align_depth_scales import align_depth_scales
    from pagas_cl.scene.view import View

    made = relief_scene(width, round(0.75 * width), contexts, held_out=0, seed=seed, **settings)
    frames, truth = frames_of(made), [made.true_depth(view.camera) * np.float32(METRES) for view in made.views]
    true = [frame.camera for frame in frames]
    cameras = noisy(true, pixels, seed, 650 * METRES)
    views = [View(camera, view.image, view.mask, view.name) for camera, view in zip(cameras, made.views)]
    depths = [frame.depth for frame in (as_network(frames, seed=seed) if kind == "network" else frames)]
    if kind == "network":
        depths = align_depth_scales(views, depths).apply(depths)
    found = refine_cameras(views, depths)
    used = choose_pairs(true, depths, Context()).used

    def left(those) -> tuple[float, float]:
        return unexplained(true, those, truth, used), rms_motion(true, after_similarity(those, true), truth)

    return {"depth": kind, "pixels": pixels, "seed": seed, "given": left(cameras), "left": left(found.cameras),
            "accepted": found.accepted, "left_out": len(found.left_out), "reason": found.reason}


def summary(rows: list[dict]) -> list[dict]:
    """A row for each depth and amount, of those that `far` gave."""
    found = []
    for kind, pixels in dict.fromkeys((row["depth"], row["pixels"]) for row in rows):
        those = [row for row in rows if (row["depth"], row["pixels"]) == (kind, pixels)]
        given, after = (np.array([row[key] for row in those]) for key in ("given", "left"))
        yes = np.array([row["accepted"] for row in those])
        worst = ["-" if not yes.any() else f"{after[yes, k].max():.2f}" for k in (0, 1)]
        seen, whole = (f"{np.median(given[:, k]):.2f}, {np.median(after[:, k]):.2f}; {worst[k]}" for k in (0, 1))
        found.append({"depth": kind, "noise, px": f"{pixels:g}", "accepted": f"{yes.sum()} of {len(yes)}",
                      "photos off: given, left; worst": seen, "after a similarity: given, left; worst": whole})
    return found


def main() -> None:
    from pagas_cl.runtime.device import open_device

    parse = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parse.add_argument("--width", type=int, default=160)
    parse.add_argument("--contexts", type=int, default=6)
    parse.add_argument("--amounts", type=float, nargs="*", default=AMOUNTS)
    parse.add_argument("--seeds", type=int, nargs="*", default=(0, 1, 2))
    parse.add_argument("--depth", nargs="*", default=("good", "network"))
    add_json(parse)
    options = parse.parse_args()
    rows = [far(kind, pixels, seed, options.width, options.contexts)
            for kind in options.depth for pixels in options.amounts for seed in options.seeds]
    record(TITLE, MEASURED, open_device(None).info.title, summary(rows), options.json)


if __name__ == "__main__":
    main()
