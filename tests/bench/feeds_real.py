"""Real photos with initial depth degraded as networks leave it: as read, brought together, refined.

    python tests/bench/feeds_real.py middlebury_stereo [--share 0.5]
    python tests/bench/feeds_real.py dtu_scan24 --mesh dtu_scan24/derived/mesh_coarse.ply --share 0.25

The depth maps get a factor within 20 %, a shift within 5 % of the median, errors that neighbours share (0.2 % of the
depth) and 3 % holes, as in feeds.py, and are refined once from there and once from what they were before ("perfect
input"). Middlebury's pairs have dense truth: mean error in pixels of disparity, away from depth edges. DTU has none:
median relative distance to what refinement makes of the perfect input; and the correlation of the two nearest photos
through each depth map, which all took part in both.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from pagas_cl.app.evaluate import compare_depth, compare_predictions
from pagas_cl.app.synthetic.examples import as_network
from pagas_cl.app.synthetic.frames import Frame
from pagas_cl.method.surface.align_depth_scales import align_depth_scales
from pagas_cl.refine import refine_views


def degraded(views, depths, seed: int) -> list:
    """Depth maps as feed-forward networks leave them; None stays."""
    there = [k for k, depth in enumerate(depths) if depth is not None]
    frames = [Frame(views[k].camera, views[k].load_image(), depths[k]) for k in there]
    found = dict(zip(there, (frame.depth for frame in as_network(frames, seed=seed))))
    return [found.get(k) for k in range(len(views))]


def stages(views, depths, seed: int, device) -> dict:
    """(view, depth map) of the views with depth, by stage; views of refined ones with the cameras they were given."""
    rough = degraded(views, depths, seed)
    together = align_depth_scales(views, rough).apply(rough)
    found = {name: [(view, depth) for view, depth in zip(views, maps) if depth is not None]
             for name, maps in (("given", depths), ("as read", rough), ("together", together))}
    for name, start in (("perfect", depths), ("refined", together)):
        results = refine_views(views, start, device=device)
        found[name] = [(replace(view, camera=result.camera), result.depth)
                       for (view, _), result in zip(found["given"], results)]
    return found


def middlebury(data: Path, share: float, seeds: int, device) -> None:
    from middlebury import PAIRS, pair

    print("| pair | given | as read | brought together | refined | perfect input | of what was read | of perfect |")
    print("|" + "---|" * 8)
    for name in PAIRS:
        views, start, truth = pair(data, name, share)
        camera = views[0].camera
        disparity = truth**2 / (camera.fx * abs(views[1].camera.center[0] - camera.center[0]))
        unit = np.where(truth > 0, disparity, np.nan)
        for seed in range(seeds):
            found = stages(views, [start, None], seed, device)
            given, read, middle, end, perfect = (
                compare_depth(found[stage][0][1], truth, camera, parallax=unit, mask=(truth > 0) & (start > 0))
                .smooth.mean_parallax for stage in ("given", "as read", "together", "refined", "perfect"))
            print(f"| {name}, draw {seed} | {given:.3f} | {read:.2f} | {middle:.3f} | {end:.3f} | {perfect:.3f} | "
                  f"{end / read:.3f} | {end / perfect:.2f} |", flush=True)


def scene(folder: Path, mesh, share: float, seeds: int, device) -> None:
    from real import load

    views, depths = load(folder, mesh, None, share)
    print("| draw | stage | distance to the refined perfect input | correlation of neighbours |\n" + "|---" * 4 + "|")
    for seed in range(seeds):
        found = stages(views, depths, seed, device)
        for stage, pairs in found.items():
            far = [np.median(np.abs(a - b)[(a > 0) & (b > 0)]) / np.median(b[b > 0])
                   for (_, a), (_, b) in zip(pairs, found["perfect"])]
            alike = [compare_predictions(view, [depth], pairs[other][0], depths[other])[0].median
                     for k, (view, depth) in enumerate(pairs) for other in nearest(views, k)]
            print(f"| {seed} | {stage} | {np.mean(far):.3%} | {np.nanmean(alike):.4f} |", flush=True)


def nearest(views, k: int) -> list[int]:
    """Places of the two views whose cameras are nearest to that of view k."""
    order = np.argsort([np.linalg.norm(view.camera.center - views[k].camera.center) for view in views], kind="stable")
    return [int(other) for other in order if other != k][:2]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--mesh", type=Path)
    parser.add_argument("--share", type=float, default=1.0)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--device")
    given = parser.parse_args()
    if given.mesh:
        scene(given.data, given.mesh, given.share, given.seeds, given.device)
    else:
        middlebury(given.data, given.share, given.seeds, given.device)


if __name__ == "__main__":
    main()
