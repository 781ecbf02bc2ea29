"""From what networks, phones and RGB-D recordings leave: errors of depth as read, brought together, and refined.

    python tests/bench/feeds.py OUT [--width 288] [--formats da3 tum ...] [--seed 0] [--off 2]

A made scene (metres) is written in each form with depth as a network leaves it: a factor a view within 20 %, a shift
within 5 %, errors that neighbours share, 3 % holes, cameras off by some pixels; the maps of networks and phones at a
quarter of the photos' size. It is read, brought together and refined as `pagas-cl refine` does. "perfect": the same
form with the coarse depth as it is, its detail (the size of the maps, the unit of the file) the same. Errors are mean
absolute depth in pixels of parallax, over all views; OUT gets table.md.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from bench.cameras import detrended
from support.camera_noise import noisy

from pagas_cl.app.synthetic import relief_scene
from pagas_cl.app.synthetic.examples import METRES, as_network, frames_of
from pagas_cl.app.synthetic.exports_depth import EXPORTS
from pagas_cl.method.surface.align_depth_scales import align_depth_scales
from pagas_cl.refine import refine_views

# size of the depth maps: forms of one kind share their perfect input
KIND = {"scannet": "half", "vggt": "square", "vggt-colmap": "middle", "bundler": "one focal length", **dict.fromkeys(
    ("7scenes", "tum", "dvmvs", "open3d", "nerfstudio", "cameras", "colmap", "mvsnet", "neus", "meshlab",
     "da3-colmap", "mapanything-colmap"), "full")}
HEAD = ("| form | as read | brought together | refined | of what was read (bar 0.2) | of perfect input (bar 1.15) "
        "| up to one scale of the whole | without shift, tilt, scale of views | processor, s |\n" + 9 * "|---" + "|\n")


def read(folder: Path, name: str):
    """Views and depths as the command line finds them."""
    from pagas_cl.app.commands._given import look

    if name == "mapanything-colmap":
        given = look(folder, photos=folder / "photos")
    elif name == "meshlab":
        given = look(folder, format="meshlab")
    else:
        given = look(folder)
    return given.scene.views, [depth.load() for depth in given.depths]


def errors(depths, made, size=lambda error, truth, both: np.abs(error)[both].mean()) -> float:
    """Mean absolute error (or another `size` of it) in pixels of parallax where there is depth, over all views."""
    unit, each = made.relief.parallax * METRES, []
    for depth, view in zip(depths, made.views):
        truth = made.true_depth(view.camera) * METRES
        both = (depth > 0) & (truth > 0)
        each.append(size((depth - truth) / unit, truth, both))
    return float(np.mean(each))


def common_factor(depths, made) -> float:
    """What brings all depth maps together nearest to the true ones: a median. Photos tell no scale of the whole, and
    cameras that are off tell it as they are off."""
    ratios = []
    for depth, view in zip(depths, made.views):
        truth = made.true_depth(view.camera) * METRES
        both = (depth > 0) & (truth > 0)
        ratios.append(truth[both] / depth[both])
    return float(np.median(np.concatenate(ratios)))


def refined(folder: Path, name: str, frames, made, mend: bool) -> tuple[float, ...]:
    """Errors of depth as read, brought together (where `mend`), and refined; of that all times one factor, and each
    view without what no photo sees."""
    EXPORTS[name](folder, frames)
    views, depths = read(folder, name)
    together = align_depth_scales(views, depths).apply(depths) if mend else depths
    after = [result.depth for result in refine_views(views, together)]
    before, middle, end = (errors(some, made) for some in (depths, together, after))
    factor = common_factor(after, made)
    return before, middle, end, errors([factor * one for one in after], made), errors(after, made, detrended)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--width", type=int, default=288)
    parser.add_argument("--context", type=int, default=5)
    parser.add_argument("--formats", nargs="*", default=list(EXPORTS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--noise", type=float, default=0.002)
    parser.add_argument("--off", type=float, default=0.0, help="pixels that cameras are off by")
    given = parser.parse_args()
    made = relief_scene(given.width, round(given.width * 0.75), given.context, held_out=0, seed=given.seed)
    best = dict[str, tuple[float, ...]]()
    frames = as_network(frames_of(made), seed=given.seed, noise=given.noise)
    cameras = noisy([frame.camera for frame in frames], given.off, given.seed, 650 * METRES)
    frames = [replace(frame, camera=camera) for frame, camera in zip(frames, cameras)]
    text = f"{len(frames)} photos of {given.width} x {round(given.width * 0.75)}\n\n{HEAD}"
    for name in given.formats:
        start, kind = time.process_time(), KIND.get(name, "quarter")
        if kind not in best:
            best[kind] = refined(given.out / f"{name}_perfect", name, frames_of(made), made, False)[2:]
        before, middle, *after = refined(given.out / name, name, frames, made, True)
        shares = " | ".join(f"{here / there:.3f}" for here, there in zip(after, best[kind]))
        text += (f"| {name} | {before:.2f} | {middle:.3f} | {after[0]:.4f} | {after[0] / before:.3f} | {shares} "
                 f"| {time.process_time() - start:.0f} |\n")
        (given.out / "table.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
