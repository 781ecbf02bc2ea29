"""Both blends against their definitions, pixel by pixel as method section 4 writes them."""

from __future__ import annotations

import numpy as np
import pytest
from support.random_scenes import pose, random_image
from support.reference_cases import BASE, CASES, central, prepared
from twins import loss as losses
from twins.composite import Rendered, _alpha_blend, composite, composite_vjp
from twins.pairs import Pairs
from twins.photo_loss import Photo, render
from twins.project import Projected, project

from pagas_cl.config import Splatting
from pagas_cl.scene.camera import Camera


def part_before_threshold(solid, z, splatting, depth_threshold):
    """What the depth threshold of the order-free blend leaves of each weight."""
    if not (splatting.occlusion and solid.any()):
        return 1.0
    first = z[solid].min()
    depth_threshold = min(depth_threshold, splatting.depth_relative * first or np.inf)
    return (1 - np.clip((z - first) / depth_threshold, 0, 1) ** 8) ** 2


def brute_force(projected, colors, photo, splatting, depth_threshold):
    """Method section 4, pixel by pixel, as it is written."""
    height, width, channels = photo.shape
    color, coverage = np.zeros(photo.shape), np.zeros((height, width))
    for row in range(height):
        for col in range(width):
            Delta = np.array([col + 0.5, row + 0.5]) - projected.m
            K = np.stack([projected.K[:, [0, 1]], projected.K[:, [1, 2]]], axis=1)
            raw = projected.o * np.exp(-0.5 * np.einsum("ni,nij,nj->n", Delta, K, Delta))
            reached = projected.valid & (np.linalg.norm(Delta, axis=1) <= splatting.radius)
            if splatting.blend == "order_free":
                t = np.linalg.norm(Delta, axis=1) ** 2 / splatting.radius**2
                alpha = np.where(reached, raw * (1 - t**4) ** 2, 0)
                solid = reached & (raw > 1 / 255)
                alpha = alpha * part_before_threshold(solid, projected.z, splatting, depth_threshold)
                total, A = alpha.sum(), min(1, alpha.sum())
                average = alpha @ colors / total if total > 0 else 0
                color[row, col], coverage[row, col] = A * average + (1 - A) * photo[row, col], A
                continue
            alpha = np.minimum(0.999, raw)
            solid = projected.z[reached & (alpha > 1 / 255)]
            farthest = np.inf
            if splatting.occlusion and len(solid):
                farthest = solid.min() + min(depth_threshold, splatting.depth_relative * solid.min() or np.inf)
            who = sorted(np.flatnonzero(reached & (projected.z <= farthest)), key=lambda i: (projected.z[i], i))
            T = 1.0
            for i in who[:128]:
                color[row, col] += T * alpha[i] * colors[i]
                T *= 1 - alpha[i]
            coverage[row, col] = 1 - T
            if splatting.normalize:
                covered = 1 - T >= 1 / 255
                color[row, col] = color[row, col] / (1 - T) if covered else photo[row, col]
    return color, coverage


@pytest.mark.parametrize("name", [n for n in CASES if "splatting__blend" in CASES[n] or "order-free" in n])
def test_blend_equals_brute_force(name):
    config = BASE.with_settings(**CASES[name])
    depth, target, contexts, state = prepared(11, config)
    for context in contexts:
        rendered = render(depth, target, context, config, state)
        photo = losses.comparable(context.image, config.loss)
        projected = project(depth, target.camera, context.camera, config.splatting.low_pass, state.scene_scale)
        color, coverage = brute_force(projected, rendered.colors, photo, config.splatting, state.depth_threshold)
        assert np.abs(rendered.color - color).max() < 1e-12
        assert np.abs(rendered.coverage - coverage).max() < 1e-12


@pytest.mark.parametrize("blend", ["order_free", "alpha"])
def test_ties_and_crowds_equal_brute_force(blend):
    """All Gaussians at one depth (the index breaks the tie), 320 of them in a few pixels (the 128 nearest count)."""
    rng = np.random.default_rng(4)
    target = Photo(Camera(20, 16, 24, 24, 10, 8, pose(np.eye(3), (0, 0, 0))), random_image(rng, 20, 16))
    camera = Camera(3, 3, 1.0, 1.0, 1.6, 1.4, pose(np.eye(3), (0.1, 0, 0)))
    photo = random_image(rng, 3, 3)
    projected = project(np.ones((16, 20)), target.camera, camera, 0.3)
    splatting = Splatting(blend=blend, radius=1.42, low_pass=0.3)
    colors = target.image.reshape(-1, 3)
    rendered = composite(projected, colors, photo, splatting, 0.1)
    count = np.bincount(rendered.pairs.pixel)
    assert count.max() == 128 if blend == "alpha" else count.max() > 128
    assert (np.diff(rendered.pairs.gaussian)[np.diff(rendered.pairs.pixel) == 0] > 0).all()
    color, coverage = brute_force(projected, colors, photo, splatting, 0.1)
    assert np.abs(rendered.color - color).max() < 1e-12 and np.abs(rendered.coverage - coverage).max() < 1e-12


@pytest.mark.parametrize("normalize", [False, True])
def test_alpha_backward_survives_opaque_gaussians(normalize):
    """No division by 1 - alpha: with alpha = 1 in front the gradient is finite and what differences say."""
    rng = np.random.default_rng(1)
    alpha, colors, photo = np.array([0.3, 1.0, 0.4]), rng.random((3, 3)), rng.random((1, 1, 3))
    splatting = Splatting(blend="alpha", normalize=normalize)
    g, g_A = rng.standard_normal((1, 1, 3)), rng.standard_normal((1, 1))

    def blended(alpha):
        pairs = Pairs(np.arange(3), np.zeros(3, int), np.zeros((3, 2)), np.arange(3.0), alpha, alpha, np.ones(3),
                      np.ones(3))
        C, A, total, covered = _alpha_blend(pairs, colors, photo.reshape(-1, 3), normalize)
        return Rendered(C.reshape(photo.shape), A.reshape(1, 1), covered.reshape(1, 1), pairs, colors,
                        photo.reshape(-1, 3), total, 3, splatting)

    got = composite_vjp(blended(alpha), g, g_A)
    for i in range(3):
        def value(by, i=i):
            r = blended(alpha + by * np.eye(3)[i])
            return (g * r.color).sum() + (g_A * r.coverage).sum()
        assert got[i] == pytest.approx(central(value, 1e-3), rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("blend", ["order_free", "alpha"])
def test_result_is_free_of_the_order_of_arrival(blend):
    config = BASE.with_settings(splatting__blend=blend, splatting__low_pass=0.3)
    depth, target, contexts, state = prepared(12, config)
    photo, colors = contexts[0].image, target.image.reshape(-1, 3)
    p = project(depth, target.camera, contexts[0].camera, 0.3, state.scene_scale)
    order = np.random.default_rng(0).permutation(len(colors))
    shuffled = Projected(*(getattr(p, name)[order] for name in Projected.__dataclass_fields__))
    one = composite(p, colors, photo, config.splatting, state.depth_threshold)
    two = composite(shuffled, colors[order], photo, config.splatting, state.depth_threshold)
    assert np.abs(one.color - two.color).max() < 1e-13 and np.abs(one.coverage - two.coverage).max() < 1e-13


@pytest.mark.parametrize("settings", [dict(radius=2.0), dict(blend="alpha", normalize=True)])
def test_constant_colour_stays_and_has_no_colour_gradient(settings):
    splatting = Splatting(**settings)
    depth, target, contexts, state = prepared(13, BASE)
    projected = project(depth, target.camera, contexts[1].camera, 0.0, state.scene_scale)
    colors = np.tile([0.2, 0.5, 0.7], (depth.size, 1))
    rendered = composite(projected, colors, contexts[1].image, splatting, state.depth_threshold)
    full = rendered.covered & (rendered.coverage == 1) if splatting.blend == "order_free" else rendered.covered
    assert full.mean() > 0.05
    assert np.abs(rendered.color[full] - colors[0]).max() < 1e-14
    assert (rendered.color == contexts[1].image)[~rendered.covered].all()
    v = composite_vjp(rendered, np.ones(rendered.color.shape) * full[..., None], np.zeros(rendered.coverage.shape))
    assert np.abs(v).max() < 1e-12


def test_order_free_image_is_continuous_in_the_depth():
    """Nothing jumps where a Gaussian comes within the radius; with the paper's steps it does. (Which surface is the
    first one is a step in both.)"""
    settings = dict(radius=1.0, low_pass=0.3, occlusion=False)
    for blend in ("order_free", "alpha"):
        config = BASE.with_settings(**{f"splatting__{k}": v for k, v in settings.items()}, splatting__blend=blend)
        depth, target, contexts, state = prepared(11, config)
        colors = [render(depth + 1e-6 * k * (depth > 0), target, contexts[0], config, state).color for k in range(750)]
        jumps = np.abs(np.diff(colors, axis=0)).max(axis=(1, 2, 3))
        assert (jumps.max() < 1e-3) == (blend == "order_free"), blend
