"""Sums of whole-number weights never wrap: the bound of options.heaviest_pixel against scenes made to exceed it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("hypothesis", reason="hypothesis is not installed: pip install 'pagas-cl[test]'")

from hypothesis import given, settings
from hypothesis import strategies as st
from support import hard_scenes as make
from support.hard_check import device_gradient, difference, normalized, twin_gradient
from support.hard_table import BLENDS
from twins.pairs import candidates
from twins.project import project

from pagas_cl.method.splat.options import fixed_bits, heaviest_pixel
from pagas_cl.scene.view import View

pytestmark = pytest.mark.kernels

OPEN = BLENDS["order-free"].with_settings(splatting__depth_slices=1e-6)     # nothing is hidden: all take part


def on_one_ray(side: int, focal, context_focal, radius_side: int = 9) -> make.HardScene:
    """Every pixel of the target at the depth where the middle column of the context camera sees it."""
    rng, principal = np.random.default_rng(0), (-0.05 * side, side / 2)
    target = View(make.camera((side, side), focal, principal=principal), make.photo(rng, (side, side)))
    rays, middle = target.camera.rays(), radius_side // 2 + 0.5
    camera = make.camera((radius_side, radius_side), context_focal, (1.0, 0.0, 0.0), principal=(middle, middle))
    context = View(camera, make.photo(rng, (radius_side, radius_side)))
    return make.HardScene(target, [context], 1.0 / rays[..., 0])


def heaviest(scene: make.HardScene, radius: float = 1.2) -> float:
    """Largest sum of weights in a pixel of any context view, in float64."""
    initial, scene_scale = normalized(scene)
    found = 0.0
    for view in scene.contexts:
        camera = view.camera
        pairs = candidates(project(initial.astype(np.float64), scene.target.camera, camera, 0.0, scene_scale),
                           camera.width,
                           camera.height, replace(OPEN.splatting, radius=radius))
        found = max(found, np.bincount(pairs.pixel, pairs.alpha, 1).max())
    return float(found)


@pytest.mark.parametrize("focal", [(300.0, 300.0), (300.0, 120000.0)])
def test_a_row_of_wide_gaussians_in_one_pixel(device, focal):
    """Pixels 400 times as wide as high, seen edge-on: 25 times the weight of square ones."""
    scene = on_one_ray(400, focal, (300.0, 300.0))
    weight = heaviest(scene)
    assert weight < 2.0 ** (32 - fixed_bits(heaviest_pixel(scene.target.camera)))
    if focal[1] > 1e5:
        assert weight > 4096, "more than 20 bits of fraction leave room for: the case shows what it should"
    initial, scene_scale = normalized(scene)
    got, _, length = device_gradient(scene, OPEN, device, initial, initial, scene_scale)
    want, _ = twin_gradient(scene, OPEN, initial, initial, scene_scale)
    assert difference(got, want, length) < 0.2          # 17 bits; sums that wrap give 1.8


@st.composite
def collapses(draw):
    """Targets of any shape of pixel whose Gaussians gather on one ray of a context camera of any focal length."""
    side = draw(st.integers(2, 60))
    focal = 10.0 ** draw(st.floats(1, 5)), 10.0 ** draw(st.floats(1, 5))
    scene = on_one_ray(side, focal, (10.0 ** draw(st.floats(0, 4)), 10.0 ** draw(st.floats(0, 4))))
    if draw(st.booleans()):          # and one that sees all of it in a few pixels
        far = 10.0 ** draw(st.floats(0, 4))
        small = 10.0 ** draw(st.floats(-1, 3))
        camera = make.camera((9, 9), (small, small), (0.0, 0.0, -far), principal=(4.5, 4.5))
        scene.contexts.append(View(camera, make.photo(np.random.default_rng(1), (9, 9))))
    return scene


@settings(max_examples=60, deadline=None, derandomize=True)
@given(scene=collapses(), radius=st.sampled_from([0.5, 1.2, 8.0]))
def test_no_sum_reaches_the_bound(scene, radius):
    assert heaviest(scene, radius) < heaviest_pixel(scene.target.camera)


@pytest.mark.parametrize("weight", [1.0, 100.0, 3e4, 2.0**24, 2.0**30])
def test_bits_leave_room(weight):
    bits = fixed_bits(weight)
    assert 1 <= bits <= 20 and weight * 2**bits <= 2**32
