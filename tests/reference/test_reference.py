"""The twins' gradients against central differences in float64.

Thresholds are piecewise constant: a pixel is differenced only where both sides keep the same participants, order,
clamps, signs (see `reference_cases.structure`); how much of a weight and of a pixel takes part is held fixed.
"""

from __future__ import annotations

import numpy as np
import pytest
from support.close import TWIN_RELATIVE, closeness, relative_errors
from support.random_scenes import random_image
from support.reference_cases import BASE, CASES, central, measured_gradient, prepared
from twins import loss as losses
from twins import smooth
from twins.pairs import ALPHA_MAX, candidates
from twins.photo_loss import render
from twins.project import project

from pagas_cl.config import Smoothness, Splatting
from pagas_cl.config.presets import PAPER


def test_random_scenes_meet_every_branch():
    depth, target, contexts, state = prepared(5, BASE)
    assert {c.camera.width for c in contexts} == {20, 24, 18} and (depth == 0).any()
    for context in contexts:
        r = render(depth, target, context, BASE, state)
        assert r.covered.mean() > 0.3 and not r.covered.all()
        every = render(depth, target, context, BASE.with_settings(splatting__occlusion=False), state)
        assert len(every.pairs.z) > len(r.pairs.z)
    sparse = render(depth, target, contexts[1], BASE.with_settings(splatting__radius=2.0), state)
    assert 0.1 < (sparse.total[sparse.covered.ravel()] < 1).mean() < 0.98


@pytest.mark.parametrize("masks", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["", "masks"])
@pytest.mark.parametrize("name", CASES)
def test_whole_gradient_against_central_differences(name, masks):
    got, want, skipped = measured_gradient(BASE.with_settings(**CASES[name]), seed=len(name), masks=masks,
                                           count=8 if masks else 20)
    assert len(got) >= 8 and skipped < 60, "too few pixels away from the thresholds"
    assert relative_errors(got, want).max() <= TWIN_RELATIVE, closeness(got, want)
    for wrong in (got * (1 + 1e-5), got + 1e-5 * np.abs(want).max() * (np.arange(len(got)) == np.abs(got).argmin())):
        assert relative_errors(wrong, want).max() > 5 * TWIN_RELATIVE, "1e-5 of the gradient is seen, at any pixel"


def test_paper_preset_against_central_differences():
    got, want, _ = measured_gradient(PAPER, seed=3)
    assert relative_errors(got, want).max() <= TWIN_RELATIVE


@pytest.mark.parametrize("low_pass", [0.0, 0.3])
def test_projection_derivatives(low_pass):
    depth, target, contexts, state = prepared(5, BASE)
    step = 1e-4
    for context in contexts:
        def at(by, context=context):
            return project(np.where(depth > 0, depth + by, 0), target.camera, context.camera, low_pass,
                           state.scene_scale)

        here = at(0)
        v = here.valid
        for value, derivative in (("z", "z_d"), ("m", "m_d"), ("Sigma", "Sigma_d")):
            want = central(lambda by: getattr(at(by), value)[v], step)
            assert relative_errors(getattr(here, derivative)[v], want).max() < 1e-8, value
        want = central(lambda by: np.log(at(by).o[v]), step)
        assert np.abs(here.log_o_d[v] - want).max() < 1e-8
        pairs = candidates(here, context.camera.width, context.camera.height, Splatting(blend="alpha", radius=1.0))
        smooth_pairs = pairs.raw < 0.99

        def weights(by):
            # the same pairs at a moved depth: the pixel stays, the mean moves
            p, pixel_center = at(by), pairs.Delta + here.m[pairs.gaussian]
            Delta = pixel_center - p.m[pairs.gaussian]
            K = p.K[pairs.gaussian]
            power = K[:, 0] * Delta[:, 0]**2 + 2 * K[:, 1] * Delta[:, 0] * Delta[:, 1] + K[:, 2] * Delta[:, 1]**2
            return p.o[pairs.gaussian] * np.exp(-0.5 * power)

        error = relative_errors(pairs.alpha_d, central(weights, step))[smooth_pairs]
        assert smooth_pairs.sum() > 100 and error.max() < 1e-7
        assert (pairs.alpha_d[pairs.raw > ALPHA_MAX] == 0).all()


@pytest.mark.parametrize("kind, discontinuity", [("planar", 1e9), ("planar", 0.7), ("planar", 0.2), ("normal", 1.0)])
def test_smoothness_gradient(kind, discontinuity):
    settings = Smoothness(kind=kind, weight=0.3, huber=0.4, discontinuity=discontinuity)
    depth, target, contexts, state = prepared(8, BASE.with_settings(smoothness__kind=kind))
    rng = np.random.default_rng(0)
    direction = rng.standard_normal(depth.shape) * (depth > 0)

    def value(by):
        return smooth.smoothness(depth + by * direction, depth > 0, settings, state.kappa, target.camera.rays(),
                                 state.texture)

    _, gradient = value(0)
    assert (gradient[depth == 0] == 0).all()
    want = central(lambda by: value(by)[0], 1e-6 if kind == "planar" else 1e-5)
    assert (gradient * direction).sum() == pytest.approx(want, rel=1e-6)


def test_ssim_gradient_and_l1_gradient():
    rng = np.random.default_rng(2)
    x, y = random_image(rng, 15, 13), random_image(rng, 15, 13)
    direction = rng.standard_normal(x.shape)
    _, gradient = losses.ssim(x, y)
    assert (gradient * direction).sum() == pytest.approx(central(lambda t: losses.ssim(x + t * direction, y)[0], 1e-5),
                                                         rel=1e-7)
    coverage, weight = rng.random(x.shape[:2]), rng.random(x.shape[:2])
    x = np.where(np.abs(x - y) < 1e-3, y + 0.01, x)
    _, v_color, v_coverage = losses.l1(x, coverage, y, weight, True)
    change = rng.standard_normal(coverage.shape)
    want = central(lambda t: losses.l1(x + t * direction, coverage + t * change, y, weight, True)[0], 1e-5)
    assert (v_color * direction).sum() + (v_coverage * change).sum() == pytest.approx(want, rel=1e-7)
