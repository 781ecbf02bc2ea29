"""Float32 on the device against the float64 twin over a whole small refinement, not one step.

Tolerance budget, in pixels of parallax: 98 of 100 pixels with texture end within 3e-3 of where the twin ends.
Elsewhere it does not hold: without texture, or with a Gaussian on a threshold, the sign of a residual may turn on the
last bit, and Adam's step does not know how small the residual was. Such pixels stay within a few steps of the rate.
"""

from __future__ import annotations

import numpy as np
import pytest

from pagas_cl.config import BALANCED, PAPER
from pagas_cl.made import relief_scene
from pagas_cl.reference.level import Photo, refine
from pagas_cl.reference.loss import w_grad
from pagas_cl.splat import refine_levels

STEPS = 40
CONFIGS = {
    "order-free": BALANCED.with_settings(solver__max_move=1e9, solver__tolerance=2.0, pyramid__steps=(STEPS,)),
    "alpha": PAPER.with_settings(pyramid__scales=(1.0,), pyramid__steps=(STEPS,), solver__rate=1e-4,
                                 solver__damping=1e-3),
}


def drift(device, blend: str):
    """|device - twin| in pixels of parallax, of refined pixels with texture and without, and the way of the twin."""
    made, config = relief_scene(64, 48, 3), CONFIGS[blend]
    target, *contexts = made.views
    truth = made.true_depth(target.camera).astype(np.float64)
    bumps = np.kron(np.random.default_rng(0).standard_normal((6, 8)), np.ones((8, 8)))
    depth = (truth * (1 + 4e-3 * bumps)).astype(np.float32)
    got = refine_levels(target, contexts, depth, config, device)
    twin = refine(depth.astype(np.float64), Photo.from_view(target), [Photo.from_view(v) for v in contexts], config)
    moved = (got.status == 1) & (got.parallax > 0)
    textured = moved & (w_grad(target.load_image() / 255.0) > 0.1)
    length = np.where(moved, got.parallax, 1)
    error, way = np.abs(got.depth - twin.depth) / length, np.abs(twin.depth - depth) / length
    return error[textured], error[moved & ~textured], way[moved]


@pytest.mark.parametrize("blend", CONFIGS)
def test_drift_of_a_whole_refinement(device, blend):
    textured, plain, way = drift(device, blend)
    assert len(textured) > 500
    assert np.median(way) > 0.02, "the refinement goes somewhere"
    assert np.quantile(textured, 0.98) < 3e-3
    assert np.concatenate([textured, plain]).max() < 1e-2
