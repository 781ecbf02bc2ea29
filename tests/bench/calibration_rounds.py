"""Are the deviations right that the rounds of agreement leave? Errors against them.

    PYTHONPATH=tests python tests/bench/calibration_rounds.py [--kinds clean gain ...] [--width 160]
        [--pairs DATA/middlebury_stereo] [--scene DIR --mesh FILE --share 0.15] [--device NAME]

Made scenes with mismatch (agreement.py) and Middlebury's pairs, both photos refined (middlebury.py), against truth.
A real scene without truth is cut into two halves that have no photo in common; each is refined by itself, and each view
compared with the three nearest of the other half: their difference over the root of the sum of both variances, at
differences below 4 pixels of parallax. Of calibrated deviations 68% lie below 1 and 95% below 2.
"""

import argparse
from pathlib import Path

import numpy as np
from agreement import KINDS, both, scene_of
from calibration import rank, ratios
from middlebury import pair
from real import load
from scipy import ndimage
from twins.agreement import difference

from pagas_cl.config.presets import BALANCED
from pagas_cl.runtime.device import open_device

FAR = 4.0        # pixels of parallax: other surfaces
TOLD = "| {} | {} | {:.0%}, {:.0%} | {:.2f}, {:.2f} | {:.2f} |"


def carried(depth, camera, other):
    """Depth map of the rectified camera `camera` seen by the other one, row by row; 0 where it is not seen."""
    shift, out = camera.fx * abs(other.center[0] - camera.center[0]), np.full(depth.shape, np.inf)
    columns = np.arange(depth.shape[1])
    for row, found in zip(depth.astype(float), out):
        with np.errstate(divide="ignore"):
            at = columns + other.cx - camera.cx - shift / row
        for k in np.flatnonzero((row[:-1] > 0) & (row[1:] > 0) & (np.abs(np.diff(at, append=0)[:-1] - 1) < 1)):
            reached = np.arange(max(0, int(np.ceil(at[k]))), min(len(row), int(np.floor(at[k + 1])) + 1))
            share = (reached - at[k]) / (at[k + 1] - at[k])
            found[reached] = np.minimum(found[reached], 1 / ((1 - share) / row[k] + share / row[k + 1]))
    return np.where(np.isfinite(out), out, 0).astype(np.float32)


def shaken(depth, seed):
    """The initial depth with a smooth error of its own, 0.5 % (root mean square) over 6 pixels: halves that start from
    one mesh would agree by that alone."""
    error = ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=depth.shape), 6.0)
    return (depth * (1 + 0.005 * error / error.std())).astype(np.float32)


def against_truth(results, truth):
    """|error| / deviation, error, deviation (pixels of parallax) of all views."""
    return [np.concatenate(each) for each in zip(*map(ratios, results, truth))]


def against_others(one, others):
    """The same of the differences between the views of both halves."""
    found = []
    for result in one:
        u = result.parallax.astype(float)
        near = sorted(others, key=lambda other: np.linalg.norm(other.camera.center - result.camera.center))[:3]
        for other in near:
            told = np.where((other.status == 1) & np.isfinite(other.deviation), other.depth, 0).astype(float)
            change, deviation = difference(result.camera, result.depth.astype(float), u, other.camera, told,
                                           np.nan_to_num(other.deviation.astype(float), posinf=0))
            both_vary = np.hypot(deviation, result.deviation)
            ok = (result.status == 1) & (np.abs(change) < FAR * u) & np.isfinite(both_vary)
            found.append([(np.abs(change) / both_vary)[ok], (np.abs(change) / u)[ok], (both_vary / u)[ok]])
    return [np.concatenate(each) for each in zip(*found)]


def tell(name, stage, found):
    ratio, error, deviation = found
    print(TOLD.format(name, stage, np.mean(ratio < 1), np.mean(ratio < 2), np.median(error), np.median(deviation),
                      rank(error, deviation)), flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kinds", nargs="*", default=[], choices=list(KINDS))
    parser.add_argument("--width", type=int, default=160)
    parser.add_argument("--pairs", type=Path)
    parser.add_argument("--scene", type=Path)
    parser.add_argument("--mesh", type=Path)
    parser.add_argument("--share", type=float, default=0.15)
    parser.add_argument("--device")
    given = parser.parse_args()
    device, config = open_device(given.device), BALANCED.with_settings(effects__cameras="off")
    print("| scene | | within 1, 2 deviations | error, deviation (medians, px) | rank correlation |", "|---" * 5 + "|",
          sep="\n")
    stages = "by themselves", "after the rounds"
    for kind in given.kinds:
        made, views = scene_of(kind, given.width)
        found = both(views, [made.initial_depth(camera) for camera in made.cameras], config, device)
        truth = [made.true_depth(camera) for camera in made.cameras]
        for stage, results in zip(stages, found):
            tell(kind, stage, against_truth(results, truth))
    for name in ("motorcycle", "dolls", "art", "cones") if given.pairs else ():
        views, *maps = pair(given.pairs, name, 0.6 if name == "motorcycle" else 0.8)
        start, truth = ([each, carried(each, *(view.camera for view in views))] for each in maps)
        for stage, results in zip(stages, both(views, start, config, device)):
            tell(name, stage, against_truth(results, truth))
    if given.scene:
        views, depths = load(given.scene, given.mesh, None, given.share)
        depths = [shaken(depth, seed) for seed, depth in enumerate(depths)]
        halves = [both(views[k::2], depths[k::2], config, device)[:2] for k in (0, 1)]
        for stage, one, other in zip(stages, *halves):
            tell(f"{given.scene.name}, halves of {len(views[::2])} and {len(views[1::2])}", stage,
                 against_others(one, other))


if __name__ == "__main__":
    main()
