"""Random cameras, depths, sizes and settings: what holds for every one of them.

PAGAS_CL_EXAMPLES=1000 runs as many a test, other ones every time; the default is a few, always the same.
"""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("hypothesis", reason="hypothesis is not installed: pip install 'pagas-cl[test]'")

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support import hard_scenes as make
from support.hard_check import device_gradient, difference, given_surface, normalized, twin_gradient
from support.hard_table import BLENDS

from pagas_cl.method.splat import PhotoStore, ViewInput, refine_levels
from pagas_cl.scene.view import View

pytestmark = pytest.mark.slow

MANY = settings(max_examples=int(os.environ.get("PAGAS_CL_EXAMPLES", 5)), deadline=None,
                derandomize="PAGAS_CL_EXAMPLES" not in os.environ, print_blob=True,
                suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
TOLERANCE = 0.3            # wide: a Gaussian on a threshold may carry a good part of a tiny image's gradient
small = lambda most: st.floats(-most, most, allow_nan=False, allow_subnormal=False)  # noqa: E731
RADII, LOW_PASS = (0.5, 1.2, 2.6), (0.0, 0.3)     # a few values: each one is a program of its own


@st.composite
def scenes(draw):
    """A scene of up to 48 x 40 pixels with one to three context views anywhere around, any depths."""
    size = draw(st.integers(1, 48)), draw(st.integers(1, 40))
    focal = 10.0 ** draw(st.floats(1, 4)), 10.0 ** draw(st.floats(1, 4))
    centers, rotations = [], []
    for _ in range(draw(st.integers(1, 3))):
        centers.append([draw(small(1.5)) for _ in range(3)])
        rotations.append(make.turn(draw(small(0.6)), draw(small(0.6)), draw(small(3.2))))
    scene = make.base(draw(st.integers(0, 2**20)), size, focal, centers, rotations)
    kind = draw(st.sampled_from(["waves", "scattered", "damaged"]))
    if kind == "scattered":
        scene = make.with_depth(scene, lambda d, rng: np.exp(draw(st.floats(0, 4)) * rng.standard_normal(d.shape)))
    if kind == "damaged":
        bad = draw(st.lists(st.sampled_from([0, -1, np.nan, np.inf, 1e-40, 1e30, 1e-20]), min_size=1, max_size=4))
        scene = make.with_depth(scene, lambda d, rng: np.where(rng.random(d.shape) < 0.3, rng.choice(bad, d.shape), d))
    return _scaled(scene, 10.0 ** draw(st.integers(-6, 6)))


def _scaled(scene, scale):
    def view(v):
        pose = v.camera.world_to_camera.copy()
        pose[:3, 3] *= scale
        return View(replace(v.camera, world_to_camera=pose), v.image)

    return make.HardScene(view(scene.target), [view(v) for v in scene.contexts], scene.depth * scale)


def config_of(blend, radius, low_pass):
    return BLENDS[blend].with_settings(splatting__radius=radius, splatting__low_pass=low_pass)


@pytest.mark.parametrize("blend", BLENDS)
@MANY
@given(scene=scenes(), radius=st.sampled_from(RADII), low_pass=st.sampled_from(LOW_PASS))
def test_gradient_is_finite_repeatable_and_near_the_twin(device, blend, scene, radius, low_pass):
    config = config_of(blend, radius, low_pass)
    initial, scene_scale = normalized(scene)
    got, loss, length = device_gradient(scene, config, device, initial, initial, scene_scale)
    again, _, _ = device_gradient(scene, config, device, initial, initial, scene_scale)
    assert np.isfinite(got).all() and np.isfinite(loss)
    assert got.tobytes() == again.tobytes()
    assert (got[initial == 0] == 0).all()
    if not (length > 0).any():
        return
    assert any(difference(got, want, length) < TOLERANCE for want in twins(scene, config, initial, scene_scale))


def twins(scene, config, initial, scene_scale):
    """The twin's gradient; then those of depths and thresholds that float32 cannot distinguish from these, for a
    Gaussian may lie on a threshold, or two at one depth, whose order the alpha blend shows."""
    rng, at = np.random.default_rng(0), initial.astype(np.float64)
    for rounding, more in ((0.0, 0.0), *[(1e-6, 0.0), (1e-6, 2e-6)] * 10):
        shaken = at * (1 + rounding * rng.uniform(-1, 1, at.shape))
        yield twin_gradient(scene, config, initial, shaken, scene_scale, more)[0]


# Programs of their own, hence few; what is a number to them is drawn freely.
SHAPES = (
    {}, dict(loss__grey=True, loss__ssim=0.0), dict(loss__structure=True, loss__robust=0.5, loss__gradient_weight=True),
    dict(splatting__occlusion=False, loss__coverage_weight=True),
    dict(splatting__depth_relative=0.3, splatting__radius=0.7),
    dict(solver__patience=2, loss__target_view=True, loss__unseen_mask=True, splatting__normalize=True),
)


@st.composite
def options(draw):
    """Settings of every stage of a refinement, their limits among them."""
    near = lambda low, high: st.one_of(st.sampled_from([low, high]), st.floats(low, high))  # noqa: E731
    shape = draw(st.sampled_from(SHAPES))
    chosen = dict(splatting__depth_slices=10.0 ** draw(near(-6, 9)), splatting__depth_footprints=draw(near(0, 1e6)),
                  smoothness__kind=draw(st.sampled_from(["none", "normal", "planar"])),
                  smoothness__weight=draw(near(0, 100)), smoothness__texture=draw(near(0, 1)),
                  smoothness__huber=10.0 ** draw(near(-6, 6)), smoothness__discontinuity=10.0 ** draw(near(-6, 12)),
                  solver__rate=10.0 ** draw(near(-12, 2)),
                  solver__rate_unit=draw(st.sampled_from(["parallax", "distance"])),
                  solver__damping=draw(near(0, 1e3)), solver__rate_floor=draw(near(0, 1)),
                  solver__final_rate=draw(near(0, 1)), solver__views_per_step=draw(st.integers(0, 4)),
                  solver__max_move=draw(near(0, 1e9)), solver__tolerance=draw(near(0, 2)),
                  solver__mismatch=draw(near(0, 2)))
    return {**chosen, **shape}


@pytest.mark.parametrize("blend", BLENDS)
@MANY
@given(scene=scenes(), chosen=options())
def test_any_settings_keep_the_promises(device, blend, scene, chosen):
    keep_promises(scene, BLENDS[blend].with_settings(pyramid__scales=(1.0,), pyramid__steps=(3,), **chosen), device)


@pytest.mark.parametrize("blend", BLENDS)
@MANY
@given(scene=scenes())
def test_a_refinement_keeps_its_promises(device, blend, scene):
    keep_promises(scene, BLENDS[blend].with_settings(pyramid__scales=(0.5, 1.0), pyramid__steps=(1, 3)), device)


def keep_promises(scene, config, device):
    """Finite, no surface made or lost, what was not refined keeps its bits, and a second run gives the same."""
    result, again = (refine_levels(ViewInput(scene.target, scene.contexts, scene.depth, device, PhotoStore(device)),
                                   config) for _ in range(2))
    assert result.depth.tobytes() == again.depth.tobytes() and result.status.tobytes() == again.status.tobytes()
    start, surface = given_surface(scene)
    assert np.isfinite(result.depth).all()
    assert not np.isnan(result.deviation).any() and not np.isnan(result.parallax).any()
    assert ((result.status > 0) == surface).all()
    assert (result.depth[surface] > 0).all() and not result.depth[~surface].any()
    kept = surface & (result.status != 1)
    assert (result.depth[kept] == start[kept]).all()
