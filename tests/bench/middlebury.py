"""Real pairs with dense truth (Middlebury): errors of depth and normals before and after, and whether deviations hold.

    python tests/bench/middlebury.py DATA [--share 0.5] [--pairs motorcycle ...] [--json FILE]
        [--set STAGE.FIELD=VALUE ...] [--set ... for another row]

DATA holds middlebury_stereo/. One context view; the initial depth is that of scenes.py, away from depth edges.
"""

import argparse
from pathlib import Path

import numpy as np
from record import add_json, record
from scenes import PAIRS, middlebury_pair

from pagas_cl.app.evaluate.depth import compare_depth
from pagas_cl.config.presets import build_config
from pagas_cl.method.view.one_view import refine_depth
from pagas_cl.runtime.device import open_device

TITLE = "Real pairs with dense truth"
MEASURED = ("Middlebury pairs, one context view, the input is the truth smoothed by 8 pixels plus a smooth error of "
            "half a pixel: mean errors away from depth edges, pixels of parallax and degrees; refined pixels within 1 "
            "and 2 deviations. Only the motorcycle's truth is finer than a third of a pixel, adirondack's is of whole "
            "pixels.")


def measured(views, start, truth, config, device) -> dict:
    """Mean errors of input and result, away from depth edges; shares within deviations and rejected."""
    camera = views[0].camera
    result = refine_depth(views[0], views[1:], start, config=config, device=device)
    shift = truth**2 / (camera.fx * abs(views[1].camera.center[0] - camera.center[0]))
    parallax = np.where(truth > 0, shift, np.nan)
    before, after = (compare_depth(each, truth, camera, parallax=parallax, mask=(truth > 0) & (start > 0)).smooth
                     for each in (start, result.depth))
    judged = (result.status == 1) & (truth > 0) & np.isfinite(result.deviation)
    ratio = np.abs(result.depth - truth)[judged] / result.deviation[judged]
    counts = result.counts
    return {"depth, input": before.mean_parallax, "depth": after.mean_parallax, "normals, input": before.normal_mean,
            "normals": after.normal_mean, "within 1 deviation": (ratio < 1).mean(),
            "within 2 deviations": (ratio < 2).mean(),
            "rejected": counts["rejected"] / max(1, counts["rejected"] + counts["refined"])}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--share", type=float, default=1.0)
    parser.add_argument("--pairs", nargs="*", default=list(PAIRS))
    parser.add_argument("--set", nargs="*", action="append", default=[], dest="settings")
    parser.add_argument("--device", default=None)
    add_json(parser)
    given = parser.parse_args()
    device, rows = open_device(given.device), []
    for name in given.pairs:
        pair = middlebury_pair(given.data, name, given.share)
        for settings in given.settings or [[]]:
            figures = measured(*pair, build_config("balanced", settings), device)
            rows.append({"pair": name, "settings": " ".join(settings), **figures})
    record(TITLE, MEASURED, device.info.title, rows, given.json)


if __name__ == "__main__":
    main()
