"""Errors of a depth map on a case, as plain numbers."""

from __future__ import annotations

import numpy as np

from pagas_cl.evaluate import compare_depth, compare_predictions
from pagas_cl.tradeoffs.case import BenchmarkCase


def score(case: BenchmarkCase, depth: np.ndarray) -> dict:
    """Errors of `depth` against the truth where there is one, and how well it predicts the held-out photos.

    Returns
    -------
    dict
        With truth: "depth", "depth_median" (scene units), "parallax" (mean, pixels of parallax), "normal" (mean,
        degrees), away from discontinuities; "edges": mean depth error within 3 pixels of them; "missing": share of
        the true pixels without a depth. With held-out photos: "unpredicted", "unpredicted_mean": 1 - median and
        1 - mean correlation of 7x7 patches, mean over the photos, and "unpredicted_before", "unpredicted_mean_before":
        the same of the initial depth over the same pixels.
    """
    return {**_errors(case, depth), **_prediction(case, depth)}


def _errors(case, depth) -> dict:
    if case.truth is None:
        return {}
    found = compare_depth(depth, case.truth, case.target.camera, parallax=case.parallax,
                          mask=case.target.load_mask(), true_normals=case.true_normals,
                          discontinuities=case.discontinuities)
    smooth, whole = found.smooth, found.all
    return {"depth": smooth.mean, "depth_median": smooth.median, "parallax": smooth.mean_parallax,
            "normal": smooth.normal_mean, "edges": found.edges.mean,
            "missing": whole.missing / max(1, whole.pixels + whole.missing)}


def _prediction(case, depth) -> dict:
    rows = []
    for other in case.held_out:
        before, after = compare_predictions(case.target, [case.initial, depth], other)
        if after.pixels:
            rows.append((1 - after.median, 1 - after.mean, 1 - before.median, 1 - before.mean))
    if not rows:
        return {}
    names = "unpredicted", "unpredicted_mean", "unpredicted_before", "unpredicted_mean_before"
    return dict(zip(names, np.mean(rows, axis=0).tolist()))
