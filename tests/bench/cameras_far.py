"""Cameras that are far off: how many are accepted, and what is left of it. No scene may be accepted that stays far off.

    python tests/bench/cameras_far.py OUT [--width 160] [--amounts 0.5 ... 30] [--seeds 0 1 2] [--depth good network]

A made scene (seven views, photos of 160 x 120), cameras turned and moved at random by the pixels given; depth as the
coarse surface has it ("good"), or as a network leaves it (a factor and a shift a view, errors, holes), brought together
under these cameras. Pixels left: what true matches are off by when each point takes the depth that suits all photos
(what photos can see), and by which photos move to the true cameras after a similarity (what depth then is off by is
bent, tilted or shifted, too). Whole photos are measured only where coarse ones do not find
together (else 0.0). OUT gets figures.json and table.md.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from support.camera_noise import after_similarity, noisy, rms_motion, unexplained

AMOUNTS = (0.5, 1.0, 3.0, 6.0, 8.0, 10.0, 14.0, 20.0, 30.0)


def far(kind: str, pixels: float, seed: int, width: int = 160, contexts: int = 6, **settings) -> dict:
    """One refinement: what it was given, what it did, what is left."""
    from pagas_cl.app.synthetic import relief_scene
    from pagas_cl.app.synthetic.examples import METRES, as_network, frames_of
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
            "accepted": found.accepted, "left_out": len(found.left_out), "reason": found.reason,
            "off": found.report["off"], "photo_offset": found.report["photo_offset"]}


def table(rows: list[dict]) -> str:
    """A line for each depth and amount."""
    lines = ["| depth | noise, px | accepted | photos off: given, left (median; worst accepted) | after a similarity: "
             "given, left | told: across depth, whole photos |", "|" + "---|" * 6]
    for kind, pixels in dict.fromkeys((row["depth"], row["pixels"]) for row in rows):
        those = [row for row in rows if (row["depth"], row["pixels"]) == (kind, pixels)]
        given, after = (np.array([row[key] for row in those]) for key in ("given", "left"))
        yes = np.array([row["accepted"] for row in those])
        worst = ["-" if not yes.any() else f"{after[yes, k].max():.2f}" for k in (0, 1)]
        seen, whole = (f"{np.median(given[:, k]):.2f}, {np.median(after[:, k]):.2f}; {worst[k]}" for k in (0, 1))
        told = ", ".join(f"{np.nanmedian([row[key] for row in those]):.1f}" for key in ("off", "photo_offset"))
        lines.append(f"| {kind} | {pixels:g} | {yes.sum()} of {len(yes)} | {seen} | {whole} | {told} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parse = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parse.add_argument("out", type=Path)
    parse.add_argument("--width", type=int, default=160)
    parse.add_argument("--contexts", type=int, default=6)
    parse.add_argument("--amounts", type=float, nargs="*", default=AMOUNTS)
    parse.add_argument("--seeds", type=int, nargs="*", default=(0, 1, 2))
    parse.add_argument("--depth", nargs="*", default=("good", "network"))
    ask = parse.parse_args()
    ask.out.mkdir(parents=True, exist_ok=True)
    rows: list[dict] = []
    for kind in ask.depth:
        for pixels in ask.amounts:
            for seed in ask.seeds:
                rows.append(far(kind, pixels, seed, ask.width, ask.contexts))
                sys.stderr.write(json.dumps(rows[-1]) + "\n")
                (ask.out / "figures.json").write_text(json.dumps(rows, indent=1))
                (ask.out / "table.md").write_text(table(rows))
    sys.stdout.write(table(rows))


if __name__ == "__main__":
    main()
