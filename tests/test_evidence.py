"""Evidence on the device against its float64 twin, and what is decided on it."""

from __future__ import annotations

import numpy as np
import pyopencl as cl
import pytest
from kernel_cases import Scene, start_level

from pagas_cl.config import BALANCED
from pagas_cl.errors import DeviceError
from pagas_cl.reference import evidence as twin
from pagas_cl.reference.pairs import candidates, nearest_surface
from pagas_cl.reference.project import project
from pagas_cl.runtime.device import open_device
from pagas_cl.scene.rig import footprint
from pagas_cl.splat.evidence import Doubt, Evidence

DOUBT = Doubt(1.5, 0.2, 0.05)
CONFIG = BALANCED.with_settings(solver__views_per_step=0)


@pytest.fixture(scope="module")
def device():
    try:
        return open_device()
    except DeviceError as error:
        pytest.skip(str(error))


def twin_evidence(scene: Scene, depth):
    """(sum of 1 - correlation, views, information) of shape (H, W, 3), and where float32 may decide otherwise."""
    total, depth, band = np.zeros((*depth.shape, 3)), depth.astype(np.float64), np.zeros(depth.shape, bool)
    for context in scene.contexts:
        p = project(depth, scene.target.camera, context.camera, 0.0, scene.unit)
        size = context.camera.width, context.camera.height
        floor = CONFIG.splatting.depth_footprints * footprint(scene.target.camera, context.camera, scene.unit)
        delta = max(scene.delta(CONFIG), floor)
        pairs = candidates(p, *size, CONFIG.splatting)
        z_first = nearest_surface(pairs, size[0] * size[1]).reshape(size[1], size[0])
        value, slope, inside = twin.warped(depth, scene.target, context, z_first, delta, scene.unit)
        cost, information, defined = twin.weigh(value, slope, inside, twin.luma(scene.target.image), DOUBT.grain)
        total += np.where(defined[..., None], np.stack([cost, np.ones_like(cost), information], axis=-1), 0)
        edge = np.abs(p.m - np.round(p.m)).min(axis=1).reshape(depth.shape) < 1e-3   # which pixel's z_first is asked
        band |= edge
    return total, band


def test_evidence_equals_the_twin(device):
    scene = Scene.make(17, width=45, height=37, contexts=3, masks=True)
    level = start_level(device, CONFIG, scene)
    judge = Evidence(level, [1, 2, 3], level.arena["depth"], DOUBT)
    judge.weigh_before()
    got = judge._read(judge._before).reshape(*scene.moved.shape, 3)
    want, band = twin_evidence(scene, scene.moved)
    level.release()
    same = (got[..., 1] == want[..., 1])
    assert same[~_near(band)].mean() > 0.99
    assert (want[..., 1] > 0).mean() > 0.3
    assert np.abs(got - want)[same][:, 0].max() < 2e-3
    informed = same & (want[..., 2] > 0)
    assert np.median(np.abs(got / np.maximum(want, 1e-12) - 1)[informed][:, 2]) < 1e-3


def test_verdicts_equal_the_twin(device):
    rng = np.random.default_rng(5)
    scene = Scene.make(17, width=45, height=37, contexts=3, masks=True)
    config = CONFIG.with_settings(solver__max_move=0.5, solver__mismatch=0.8, solver__tolerance=0.1)
    level = start_level(device, config, scene)
    unit, initial = level.read("unit", scene.moved.shape), level.read("depth", scene.moved.shape)
    entered = device.memory.buffer(device.context, initial.nbytes)
    cl.enqueue_copy(device.queue, entered, initial)
    judge = Evidence(level, [1, 2, 3], entered, Doubt(1.5, 0.2))
    judge.weigh_before()
    refined = np.where(initial > 0, initial + rng.normal(0, 0.3, initial.shape) * unit, 0).astype(np.float32)
    cl.enqueue_copy(device.queue, level.arena["depth"], refined)
    judge.weigh_after()
    before, after = (judge._read(e).reshape(*initial.shape, 3).astype(np.float64) for e in (judge._before, judge._after))
    verdict = judge.decide(initial.shape)
    status, accepted = verdict.status, level.read("depth", initial.shape).astype(np.float64)
    level.release()
    feathered = twin.feather(initial.astype(np.float64), refined.astype(np.float64), status)
    assert np.abs(accepted - feathered).max() < 1e-6 and (feathered != refined)[status == 1].mean() > 0.3
    deviations = twin.deviation(accepted, status, unit.astype(np.float64), before, after, 1.5, 0.2)
    assert (np.isfinite(deviations) == np.isfinite(verdict.deviation)).all()
    known = np.isfinite(deviations) & (deviations > 0)
    assert known.mean() > 0.3 and np.quantile(np.abs(verdict.deviation / np.where(known, deviations, 1) - 1)[known], 0.99) < 1e-3
    want = twin.decide(initial, refined, unit, before, after, 0.5, 0.1, 0.8)
    assert (np.bincount(want.ravel(), minlength=4) > 0).all()
    assert (status == want).mean() > 0.999


def _near(band):
    grown = np.pad(band, 2)
    return np.any([grown[y:y + band.shape[0], x:x + band.shape[1]] for y in range(5) for x in range(5)], axis=0)


def test_a_worse_depth_is_sent_back_bit_for_bit(device):
    from pagas_cl.made import relief_scene
    from pagas_cl.splat import refine_levels

    made = relief_scene(96, 72, 2)
    view, *others = made.views
    truth = made.true_depth(view.camera).astype(np.float32)
    steps = CONFIG.with_settings(pyramid__steps=(3,), solver__rate=3.0, solver__tolerance=0.0, solver__max_move=100.0)
    result = refine_levels(view, others, truth, steps, device)       # steps of three pixels away from the truth
    rejected = result.status == 3
    assert rejected.mean() > 0.1
    assert (result.depth[rejected] == truth[rejected]).all()
    initial = made.initial_depth(view.camera).astype(np.float32)
    better = refine_levels(view, others, initial, CONFIG.with_settings(pyramid__steps=(20,)), device)
    assert (better.depth != initial)[better.status == 1].mean() > 0.9
