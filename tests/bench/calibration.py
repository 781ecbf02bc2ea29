"""Is the standard deviation that a refinement gives right? Errors against it, on scenes with truth.

    python tests/bench/calibration.py [--data DIR] [--width 300] [--device NAME] [--json FILE]

For each scene the distribution of |error| / deviation over the refined pixels: of calibrated deviations 68% lie below 1
and 95% below 2. DIR holds Middlebury's motorcycle, as in scenes.py.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from record import add_json, record
from scenes import middlebury_pair
from scipy.stats import spearmanr
from support.synthetic import relief_scene

from pagas_cl.method.view.one_view import refine_depth
from pagas_cl.runtime.device import open_device

TITLE = "Deviations: are they right?"
MEASURED = ("Of calibrated deviations 68 % of the errors lie below 1 and 95 % below 2 of them; error and deviation in "
            "pixels of parallax (medians), what 68 % and 95 % of error / deviation lie below, and the rank correlation "
            "of both.")
MADE = {"made, clean": {}, "made, exposure jitter": dict(steps=0, exposure=0.3),
        "made, noise": dict(steps=0, contrast=0.25, noise=6.0), "made, occluder": dict(bar=8.0),
        "made, shiny": dict(steps=0, shine=0.5)}


def scenes(width: int, data: Path | None, seed: int = 0):
    """(name, target, contexts, initial depth, true depth) of each."""
    for name, settings in MADE.items():
        made = relief_scene(width, width * 3 // 4, 5, held_out=0, seed=seed, **settings)
        camera = made.cameras[0]
        yield name, made.views[0], made.views[1:], made.initial_depth(camera), made.true_depth(camera)
    if data is not None:
        (target, *contexts), depth, truth = middlebury_pair(data, "motorcycle", 0.5)
        yield "Middlebury motorcycle, real", target, contexts, depth, truth


def ratios(result, truth):
    """|error| / deviation of the refined pixels with truth, and error and deviation in pixels of parallax."""
    ok = (result.status == 1) & (truth > 0) & np.isfinite(result.deviation) & (result.parallax > 0)
    error, deviation, parallax = (x[ok].astype(np.float64) for x in (
        np.abs(result.depth - truth), result.deviation, result.parallax))
    return error / deviation, error / parallax, deviation / parallax


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path)
    parser.add_argument("--width", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0, help="of the synthetic scenes")
    parser.add_argument("--device")
    add_json(parser)
    given = parser.parse_args()
    device, rows = open_device(given.device), []
    for name, target, contexts, depth, truth in scenes(given.width, given.data, given.seed):
        ratio, error, deviation = ratios(refine_depth(target, contexts, depth, device=device), truth)
        rows.append({"scene": name, "pixels": len(ratio), "error, px (median)": np.median(error),
                     "deviation, px (median)": np.median(deviation),
                     "68% of error / deviation": np.quantile(ratio, 0.68), "95% of it": np.quantile(ratio, 0.95),
                     "rank correlation": spearmanr(error, deviation).statistic})
    record(TITLE, MEASURED, device.info.title, rows, given.json)


if __name__ == "__main__":
    main()
