"""What must hold for the twins whatever the scene."""

from __future__ import annotations

import numpy as np
import pytest
from support.close import closeness, near_thresholds
from support.random_scenes import pose, random_image, random_scene, rotation
from support.reference_cases import BASE, CASES, prepared
from twins.level import loss_and_gradient, prepare, views_of_step
from twins.photo_loss import Photo, render, view_loss
from twins.project import project
from twins.units import depth_threshold_of, median_depth

from pagas_cl.config import Config
from pagas_cl.scene.camera import Camera


@pytest.mark.parametrize("name", ["order-free", "order-free low-pass", "alpha low-pass", "alpha normalised"])
def test_zero_baseline_has_zero_gradient(name):
    config = BASE.with_settings(**CASES[name])
    rng = np.random.default_rng(6)
    depth, _, _ = random_scene(6)
    target = Photo(Camera(20, 16, 24, 24, 10, 8, pose(np.eye(3), (0, 0, 0))), random_image(rng, 20, 16))
    turned = Photo(Camera(22, 15, 30, 28, 11, 7, pose(rotation((0.1, -0.05, 0.2)), (0, 0, 0))),
                   random_image(rng, 22, 15))
    state = prepare(depth, target, [target, turned], config, 1.0, 0.05)
    value, gradient = loss_and_gradient(depth, target, [target, turned], config, state)
    assert value > 0 and (gradient == 0).all() and (state.parallax == 0).all() and (state.kappa == 0).all()


def test_target_view_only_adds_to_the_mean():
    config = BASE.with_settings(loss__target_view=True)
    depth, target, contexts, state = prepared(7, config)
    with_it, g1 = loss_and_gradient(depth, target, contexts, config, state)
    without, g0 = loss_and_gradient(depth, target, contexts, BASE, state)
    own, g_own = view_loss(depth, target, target, config, state)
    assert (g_own == 0).all() and with_it == pytest.approx((3 * without + own) / 4, rel=1e-12)
    assert np.allclose(4 * g1, 3 * g0, rtol=1e-12)


def test_some_views_are_their_mean():
    depth, target, contexts, state = prepared(7, BASE)
    value, gradient = loss_and_gradient(depth, target, contexts, BASE, state, views=[2, 0])
    one = [view_loss(depth, target, contexts[v], BASE, state, state.seen[v]) for v in (0, 2)]
    assert value == pytest.approx((one[0][0] + one[1][0]) / 2, rel=1e-12)
    assert np.allclose(gradient, depth.size * (one[0][1] + one[1][1]) / 2, rtol=1e-12)
    assert [views_of_step(s, 3, 2) for s in range(3)] == [[0, 1], [2, 0], [1, 2]]
    assert views_of_step(5, 3, 0) == [0, 1, 2]


@pytest.mark.parametrize("scale, offset, bound", [(1e-3, (0, 0, 0), 1e-10), (1e3, (0, 0, 0), 1e-10),
                                                  (1.0, (5e6, -5e6, 5e6), 1e-5)])
def test_scale_and_place_change_nothing(scale, offset, bound):
    config = Config().with_settings(splatting__low_pass=0.3)
    results = []
    for kind in (dict(), dict(scale=scale, offset=offset)):
        depth, target, contexts = random_scene(9, **kind)
        scene_scale = median_depth(depth)
        state = prepare(depth / scene_scale, target, contexts, config, scene_scale,
                        depth_threshold_of(depth / scene_scale, 20))
        results.append((*loss_and_gradient(depth / scene_scale, target, contexts, config, state), state.parallax))
    (value, gradient, u), (value2, gradient2, u2) = results
    assert value2 == pytest.approx(value, rel=bound)
    assert closeness(gradient2, gradient).relative_l2 < bound and np.allclose(u2, u, rtol=bound)


def test_near_thresholds_marks_what_a_perturbed_twin_decides_otherwise():
    config = BASE.with_settings(splatting__blend="alpha", splatting__radius=1.42)
    depth, target, contexts, state = prepared(15, config, width=48, height=40)
    context = contexts[0]
    size = context.camera.width, context.camera.height
    projected = project(depth, target.camera, context.camera, 0.0, state.scene_scale)
    near = near_thresholds(projected, *size, config.splatting, state.depth_threshold, pixels=1e-3, relative=1e-3)
    assert 0 < near.mean() < 0.3
    other = depth * (1 + 1e-5 * np.random.default_rng(0).standard_normal(depth.shape))
    here = render(depth, target, context, config, state)
    there = render(other, target, context, config, state)

    def sets(r):
        return set(zip(r.pairs.pixel.tolist(), r.pairs.gaussian.tolist()))

    flipped = {pixel for pixel, _ in sets(here) ^ sets(there)}
    assert flipped and near.ravel()[list(flipped)].all()
