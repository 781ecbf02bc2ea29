"""Smoothness where a surface is specular: the weights against their twin, and that the effect gains what it is for."""

from __future__ import annotations

import numpy as np
import pytest
from support.acceptance_scenes import figures
from support.kernel_cases import Scene, start_level
from support.scenes import relief_scene
from twins.smooth import raised

from pagas_cl.config.presets import BALANCED
from pagas_cl.method.view.one_view import refine_depth


def weights(device, specularity, **settings):
    scene = Scene.make(17, width=45, height=37, contexts=2)
    level = start_level(device, BALANCED.with_settings(smoothness__texture=0.5, **settings), scene, specularity)
    found = level.read("weights", scene.initial.shape).astype(np.float64), level.buffers.raised is not None
    level.release()
    return found


@pytest.mark.kernels
@pytest.mark.parametrize("shape", [(37, 45), (9, 12), (1, 1)])
def test_weights_equal_the_twin(device, shape):
    specularity = np.random.default_rng(0).uniform(0, 0.03, shape).astype(np.float32)
    specularity[::4, ::3] = np.nan
    plain, _ = weights(device, specularity)
    got, has_buffer = weights(device, specularity, smoothness__specularity=5.0)
    assert has_buffer and np.abs(got / raised(plain, specularity, 5.0) - 1).max() < 1e-5


@pytest.mark.kernels
def test_without_gloss_nothing_changes(device):
    plain, has_buffer = weights(device, None)
    assert not has_buffer
    assert (weights(device, None, smoothness__specularity=5.0)[0] == plain).all()
    assert (weights(device, np.zeros((9, 12), np.float32), smoothness__specularity=5.0)[0] == plain).all()


def depths_of_steps(device, monkeypatch, **settings):
    scene = Scene.make(17, width=45, height=37, contexts=2)
    specularity = np.full((9, 12), 0.03, np.float32)
    level, depths = start_level(device, BALANCED.with_settings(**settings), scene, specularity, raised=False), []
    monkeypatch.setattr("pagas_cl.method.splat.step.AHEAD", 0)     # each step is reported before the next
    level.run(6, lambda *_: depths.append(level.read("depth", scene.initial.shape)))
    level.release()
    return depths


@pytest.mark.kernels
@pytest.mark.parametrize("patience, first", [(0, 2), (10, 0)])
@pytest.mark.parametrize("raised", [dict(smoothness__full_views=40), dict(smoothness__specularity=9.0)],
                         ids=["few", "specularity"])
def test_the_photos_come_first(device, monkeypatch, raised, patience, first):
    """What smoothness is raised by counts from two fifths of the steps on; from the start where the loss may end it."""
    plain = dict(smoothness__full_views=1, smoothness__specularity=0.0, solver__patience=patience)
    pairs = zip(depths_of_steps(device, monkeypatch, **plain), depths_of_steps(device, monkeypatch, **plain | raised))
    assert [(a == b).all() for a, b in pairs] == [step < first for step in range(6)]


@pytest.mark.kernels
def test_smoothness_weighs_its_early_share_until_then(device, monkeypatch):
    early, late, half = (depths_of_steps(device, monkeypatch, **settings) for settings in (
        dict(smoothness__early=0.5), dict(), dict(smoothness__weight=0.5 * BALANCED.smoothness.weight,
                                                  solver__photos_first=1.0)))
    assert [(a == b).all() for a, b in zip(early, half)] == [True, True, *[False] * 4]
    assert not any((a == b).all() for a, b in zip(early, late))


@pytest.mark.slow
def test_a_glossy_surface_gains_depth_and_loses_no_normals(device):
    made = relief_scene(120, 90, 4, held_out=0, steps=0, shine=0.5)
    target, *contexts = made.views
    initial = made.initial_depth(made.cameras[0])
    auto = refine_depth(target, contexts, initial, device=device)
    off = refine_depth(target, contexts, initial, device=device, config=BALANCED.with_settings(effects__noise="off"))
    before, after, without = (figures(made, depth) for depth in (initial, auto.depth, off.depth))
    assert after["mean"] < 0.8 * before["mean"] and after["mean"] < 0.9 * without["mean"]
    assert after["normal mean"] < 1.02 * before["normal mean"] and after["normal mean"] < 0.8 * without["normal mean"]
