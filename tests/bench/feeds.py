"""From what networks, phones and RGB-D recordings leave: errors of depth as read, aligned in scale, and refined.

    python tests/bench/feeds.py [--json FILE] [--width 288] [--formats da3 tum ...] [--seed 0] [--off 2]

A made scene (metres) is written in each form with depth as a network leaves it: a factor a view within 20 %, a shift
within 5 %, errors that neighbours share, 3 % holes, cameras off by some pixels; the maps of networks and phones at a
quarter of the photos' size. It is read, aligned in scale and refined as `pagas-cl refine` does. "perfect": the same
form with the coarse depth as it is, its detail (the size of the maps, the unit of the file) the same. Errors are mean
absolute depth in pixels of parallax, over all views.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from bench.cameras import detrended
from bench.record import add_json, record
from support.camera_noise import noisy
from support.example_scenes import METRES, as_network, frames_of
from support.exports_depth import EXPORTS
from support.synthetic import relief_scene

from pagas_cl.method.surface.align_depth_scales import align_depth_scales
from pagas_cl.refine import refine_views
from pagas_cl.runtime.device import open_device

# size of the depth maps: forms of one kind share their perfect input
KIND = {"scannet": "half", "vggt": "square", "vggt-colmap": "middle", "bundler": "one focal length", **dict.fromkeys(
    ("7scenes", "tum", "dvmvs", "open3d", "nerfstudio", "cameras", "colmap", "mvsnet", "neus", "meshlab",
     "da3-colmap", "mapanything-colmap"), "full")}
TITLE = "Depth of networks, phones and recordings"
MEASURED = ("Photos of a synthetic scene, written in each form with depth as networks leave it (factors within 20 % "
            "and shifts within 5 % in each view, smooth errors, 3 % holes): mean depth error over all views in pixels "
            "of parallax as read, after the scales of the maps are aligned, refined; `of perfect input`: the same form "
            "with the depth right but coarse.")


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
    """The factor of all depth maps that is nearest to the true ones: a median. Photos leave the scale of the whole
    open, and cameras that are off change it."""
    ratios = []
    for depth, view in zip(depths, made.views):
        truth = made.true_depth(view.camera) * METRES
        both = (depth > 0) & (truth > 0)
        ratios.append(truth[both] / depth[both])
    return float(np.median(np.concatenate(ratios)))


def refined(folder: Path, name: str, frames, made, mend: bool) -> tuple[float, ...]:
    """Errors of depth as read, aligned in scale (where `mend`), and refined; of that all times one factor, and each
    view without what no photo sees."""
    EXPORTS[name](folder, frames)
    views, depths = read(folder, name)
    together = align_depth_scales(views, depths).apply(depths) if mend else depths
    after = [result.depth for result in refine_views(views, together)]
    before, middle, end = (errors(some, made) for some in (depths, together, after))
    factor = common_factor(after, made)
    return before, middle, end, errors([factor * one for one in after], made), errors(after, made, detrended)


def rows_of(folder: Path, formats, frames, made) -> list[dict]:
    """A row for each form."""
    best: dict[str, tuple[float, ...]] = {}
    rows = []
    for name in formats:
        start, kind = time.process_time(), KIND.get(name, "quarter")
        if kind not in best:
            best[kind] = refined(folder / f"{name}_perfect", name, frames_of(made), made, False)[2:]
        before, middle, *after = refined(folder / name, name, frames, made, True)
        shares = [here / there for here, there in zip(after, best[kind])]
        rows.append({"form": name, "as read": before, "aligned in scale": middle, "refined": after[0],
                     "of what was read": after[0] / before, "of perfect input": shares[0],
                     "up to one scale of the whole": shares[1], "without shift, tilt, scale of views": shares[2],
                     "processor time, s": time.process_time() - start})
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--width", type=int, default=288)
    parser.add_argument("--context", type=int, default=5)
    parser.add_argument("--formats", nargs="*", default=list(EXPORTS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--noise", type=float, default=0.002)
    parser.add_argument("--off", type=float, default=0.0, help="pixels that cameras are off by")
    add_json(parser)
    given = parser.parse_args()
    made = relief_scene(given.width, round(given.width * 0.75), given.context, held_out=0, seed=given.seed)
    frames = as_network(frames_of(made), seed=given.seed, noise=given.noise)
    cameras = noisy([frame.camera for frame in frames], given.off, given.seed, 650 * METRES)
    frames = [replace(frame, camera=camera) for frame, camera in zip(frames, cameras)]
    with tempfile.TemporaryDirectory() as folder:
        rows = rows_of(Path(folder), given.formats, frames, made)
    record(TITLE, MEASURED, open_device(None).info.title, rows, given.json)


if __name__ == "__main__":
    main()
