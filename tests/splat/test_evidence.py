"""Evidence on the device against its float64 twin, and what is decided on it."""

from __future__ import annotations

import numpy as np
import pyopencl as cl
import pytest
from support.kernel_cases import Scene, start_level
from twins import evidence as twin
from twins.pairs import candidates, nearest_surface
from twins.project import project

from pagas_cl.config.presets import BALANCED
from pagas_cl.method.splat.constants import COST_GROUP
from pagas_cl.method.splat.evidence import _SUM_GROUPS, Evidence, EvidencePrior, _median
from pagas_cl.method.splat.options import defines
from pagas_cl.runtime.memory import download
from pagas_cl.runtime.program import bind, build, run_once
from pagas_cl.scene.camera import footprint

pytestmark = pytest.mark.kernels

PRIOR = EvidencePrior(1.5, 0.2, 0.05)
CONFIG = BALANCED.with_settings(solver__views_per_step=0, effects__mismatch="off")


def twin_evidence(scene: Scene, depth):
    """(sum of 1 - correlation, views, information) of shape (H, W, 3), and where float32 may decide otherwise."""
    total, depth, band = np.zeros((*depth.shape, 3)), depth.astype(np.float64), np.zeros(depth.shape, bool)
    for context in scene.contexts:
        p = project(depth, scene.target.camera, context.camera, 0.0, scene.scene_scale)
        size = context.camera.width, context.camera.height
        floor = CONFIG.splatting.depth_footprints * footprint(scene.target.camera, context.camera, scene.scene_scale)
        depth_threshold = max(scene.depth_threshold(CONFIG), floor)
        pairs = candidates(p, *size, CONFIG.splatting)
        z_first = nearest_surface(pairs, size[0] * size[1]).reshape(size[1], size[0])
        value, slope, inside = twin.warped(depth, scene.target, context, z_first, depth_threshold, scene.scene_scale)
        cost, information, defined = twin.weigh(value, slope, inside, twin.luma(scene.target.image),
                                                PRIOR.noise_variance)
        total += np.where(defined[..., None], np.stack([cost, np.ones_like(cost), information], axis=-1), 0)
        edge = np.abs(p.m - np.round(p.m)).min(axis=1).reshape(depth.shape) < 1e-3   # which pixel's z_first is read
        band |= edge
    return total, band


def evidence_of(level, numbers, initial, *prior):
    """Evidence by the views of `numbers`, from 1."""
    return Evidence(level.programs, level.buffers, [level.views[k - 1] for k in numbers], initial, *prior)


def test_evidence_equals_the_twin(device):
    scene = Scene.make(17, width=45, height=37, contexts=3, masks=True)
    level = start_level(device, CONFIG, scene)
    judge = evidence_of(level, [1, 2, 3], level.buffers.depth, PRIOR)
    judge.weigh()
    got = download(device, judge.before, (*scene.moved.shape, 3))
    want, band = twin_evidence(scene, scene.moved)
    level.release()
    same = (got[..., 1] == want[..., 1])
    assert same[~_near(band)].mean() > 0.99
    assert (want[..., 1] > 0).mean() > 0.3
    assert np.abs(got - want)[same][:, 0].max() < 2e-3
    informed = same & (want[..., 2] > 0)
    assert np.median(np.abs(got / np.maximum(want, 1e-12) - 1)[informed][:, 2]) < 1e-3


def entered_level(device, config, scene):
    """A level that is ready for its steps, its depth_per_parallax and depth, and a buffer that keeps that depth."""
    level = start_level(device, config, scene)
    depth_per_parallax, initial = level.read("depth_per_parallax", scene.moved.shape), level.read("depth",
                                                                                                  scene.moved.shape)
    normalized = device.buffer(initial.nbytes)
    cl.enqueue_copy(device.queue, normalized, initial)
    return level, depth_per_parallax, initial, normalized


@pytest.fixture
def without_holding(monkeypatch):
    """What no photo speaks for is held in a test of its own."""
    monkeypatch.setattr(Evidence, "_hold_uninformative", lambda *_: lambda: 0)


def test_verdicts_equal_the_twin(device, without_holding):
    rng = np.random.default_rng(5)
    scene = Scene.make(17, width=45, height=37, contexts=3, masks=True)
    config = CONFIG.with_settings(solver__max_move=0.5, solver__mismatch=0.9, solver__tolerance=0.1)
    level, depth_per_parallax, initial, normalized = entered_level(device, config, scene)
    judge = evidence_of(level, [1, 2, 3], normalized, EvidencePrior(1.5, 0.2))
    refined = np.where(initial > 0, initial + rng.normal(0, 0.3, initial.shape) * depth_per_parallax,
                       0).astype(np.float32)
    cl.enqueue_copy(device.queue, level.buffers.depth, refined)
    decision = judge.decide()
    before, after = (download(device, e, (*initial.shape, 3)).astype(np.float64) for e in (judge.before, judge.after))
    status, deviation = (download(device, buffer, initial.shape, dtype)
                         for buffer, dtype in ((decision.status, np.uint8), (decision.deviation, np.float32)))
    accepted = level.read("depth", initial.shape).astype(np.float64)
    level.release()
    feathered = twin.feather(initial.astype(np.float64), refined.astype(np.float64), status)
    assert np.abs(accepted - feathered).max() < 1e-6 and (feathered != refined)[status == 1].mean() > 0.3
    deviations = twin.deviation(accepted, status, depth_per_parallax.astype(np.float64), before, after, 1.5, 0.2, 0.9)
    assert (np.isfinite(deviations) == np.isfinite(deviation)).all()
    known = np.isfinite(deviations) & (deviations > 0)
    off = np.abs(deviation / np.where(known, deviations, 1) - 1)
    assert known.mean() > 0.3 and np.quantile(off[known], 0.99) < 1e-3
    want = twin.decide(initial, refined, depth_per_parallax, before, after, 0.5, 0.1, 0.9)
    assert (np.bincount(want.ravel(), minlength=4) > 0).all()
    assert (status == want).mean() > 0.999


class Kernels:
    """evidence.cl on arrays: each call runs one kernel and returns what its buffers hold then."""

    def __init__(self, device):
        self.device, self.program = device, build(device, "evidence.cl", defines(CONFIG, device, 64.0))

    def __call__(self, name, size, *arguments, group=None):
        on_device = [self._buffer(a) if isinstance(a, np.ndarray) else a for a in arguments]
        named = dict(zip(self.program.signatures[name], on_device, strict=True))
        run_once(self.device.queue, [bind(self.program, name, size, group, **named)])
        out = [(a.copy(), b) for a, b in zip(arguments, on_device) if isinstance(a, np.ndarray)]
        for array, buffer in out:
            cl.enqueue_copy(self.device.queue, array, buffer)
        return [array for array, _ in out]

    def _buffer(self, array):
        buffer = self.device.buffer(array.nbytes)
        cl.enqueue_copy(self.device.queue, buffer, array)
        return buffer


@pytest.fixture
def kernels(device):
    return Kernels(device)


def random_evidence(rng, *shape, views=3):
    """Evidence of some shape, float32 (..., 3): costs below 0 and above 2 too, a quarter of the pixels not seen. No
    cost is within a tenth of a bin of the next one, so that float32 and float64 count alike."""
    seen = rng.integers(0, views + 1, shape)
    cost = (rng.integers(-100, twin.BINS + 100, shape) + rng.uniform(0.1, 0.9, shape)) * (2 / twin.BINS)
    return np.stack([cost * seen, seen, rng.uniform(0, 1, shape)], axis=-1).astype(np.float32)


@pytest.mark.parametrize("count", [1, 700, 17_001])       # fewer and more than the work-items that share them
def test_means_of_costs_equal_the_twin(kernels, count):
    rng = np.random.default_rng(count)
    before, after = random_evidence(rng, count), random_evidence(rng, count)
    before[0, 1], after[0, 1] = 2, 1                       # seen both times, be it the only one
    *_, sums = kernels("sum_costs", (_SUM_GROUPS * COST_GROUP,), before, after, count,
                       np.zeros((_SUM_GROUPS, 3), np.int64), group=(COST_GROUP,))
    was, now, pixels = sums.sum(axis=0).tolist()
    assert pixels == np.count_nonzero(twin.costs(before, after)[2]) > 0
    want = twin.mean_costs(before.astype(np.float64), after.astype(np.float64))
    # rounded to 2^-20 each, and a division in float32
    assert (was / pixels / 2**20, now / pixels / 2**20) == pytest.approx(want, abs=2e-6)


def test_means_and_medians_of_nothing_are_not_known(device):
    level = start_level(device, CONFIG, Scene.make(3))
    judge = evidence_of(level, [1], level.buffers.depth)
    judge.before, judge.after = (judge.device.buffer(12 * level.target.size.pixels) for _ in range(2))
    seen = np.zeros((level.target.size.pixels, 3), np.float32)
    seen[::2] = 1, 1, 0
    for buffer, array in ((judge.before, seen), (judge.after, seen[::-1].copy())):       # never both times
        cl.enqueue_copy(device.queue, buffer, array)
    assert np.isnan(judge.costs()()).all() and np.isnan(judge.medians()()).all()
    assert np.isnan(twin.mean_costs(seen, seen[::-1])).all()
    level.release()


@pytest.mark.parametrize("count", [1, 700, 17_001])
def test_counts_of_costs_equal_the_twin(kernels, count):
    rng = np.random.default_rng(count)
    before, after = random_evidence(rng, count), random_evidence(rng, count)
    before[0, 1], after[0, 1] = 2, 1
    *_, counts = kernels("count_costs", (count,), before, after, count, np.zeros((2, twin.BINS), np.uint32))
    assert (counts == twin.counted_costs(before, after)).all()
    was, now, known = twin.costs(before.astype(np.float64), after.astype(np.float64))
    for row, cost in zip(counts, (was, now)):
        middle = np.median(np.clip(cost[known], 0, 2))
        # between the two middle ones of an even number every value is a median; bins are 2 / 1024 wide
        gap = np.ptp(np.sort(np.clip(cost[known], 0, 2))[[(known.sum() - 1) // 2, known.sum() // 2]])
        assert _median(row) == pytest.approx(middle, abs=gap + 2 / twin.BINS)


def test_growth_of_costs_equals_the_twin(kernels):
    rng = np.random.default_rng(2)
    before, after = random_evidence(rng, 23, 31), random_evidence(rng, 23, 31)
    *_, grown = kernels("worse_costs", (23 * 31,), before, after, 23 * 31, np.full((23, 31, 2), np.nan, np.float32))
    known = twin.costs(before, after)[2]
    assert 0.4 < known.mean() < 0.8
    assert (grown[..., 1] == known).all() and (grown[~known] == 0).all()
    assert np.abs(grown[..., 0] - twin.worse(before.astype(np.float64), after.astype(np.float64))).max() < 1e-6


@pytest.mark.parametrize("height, width", [(1, 1), (3, 40), (23, 31)])      # narrower than a window, and wider
@pytest.mark.parametrize("stride", [2, 3])
def test_sums_over_surroundings_equal_the_twin(kernels, height, width, stride):
    rng = np.random.default_rng(height)
    given, size = rng.normal(size=(height, width, stride)).astype(np.float32), (width, height)
    _, rows = kernels("sum_window", size, given, stride, width, height, 1, 0, np.zeros((height, width, 2), np.float32))
    _, around = kernels("sum_window", size, rows, 2, width, height, 0, 1, np.zeros((height, width, 2), np.float32))
    want = np.stack([twin._patch_sum(given[..., k].astype(np.float64), twin.WINDOW) for k in (0, 1)], axis=-1)
    assert np.abs(around - want).max() < 2e-5               # 225 numbers of order 1 in float32


def test_refusal_equals_the_twin(kernels):
    """Every status, growth of either sign, and exactly none, with the border in it."""
    rng = np.random.default_rng(4)
    height, width = shape = 37, 45
    status = rng.integers(0, 4, shape).astype(np.uint8)
    growth = np.zeros(shape)
    growth[:, :12] = rng.normal(0, 0.3, (height, 12)) + np.where(np.arange(height) < 18, 0.1, -0.1)[:, None]
    pairs = np.stack([growth, growth != 0], axis=-1).astype(np.float32)
    for _ in range(2):
        for dx, dy in ((1, 0), (0, 1)):
            _, pairs = kernels("sum_window", (width, height), pairs, 2, width, height, dx, dy, np.zeros_like(pairs))
    _, got = kernels("refuse", (height * width,), height * width, pairs, status)
    around = twin._patch_sum(twin._patch_sum(growth, twin.WINDOW), twin.WINDOW)
    sure = (np.abs(around) > 1e-3) | (around == 0)           # sums of 225^2 numbers in float32
    assert sure.mean() > 0.99
    assert ((around == 0) & (status == 1)).sum() > 50       # nothing is known near the last columns
    assert ((around > 0) & (status == 1)).sum() > 50 and ((around < 0) & (status == 1)).sum() > 50
    assert (got == twin.refuse(status, growth))[sure].all()


def test_holding_what_photos_do_not_show_equals_the_twin(kernels):
    """Every status; columns where photos speak for all, some and none."""
    rng = np.random.default_rng(6)
    height, width = shape = 41, 70
    status = rng.choice(np.array([0, 1, 1, 1, 1, 1, 1, 2, 3], np.uint8), shape)
    initial = rng.uniform(1, 2, shape).astype(np.float32)
    refined = initial + np.float32(0.1)
    deviation = np.where(rng.uniform(size=shape) < np.linspace(1.2, -0.6, width), 0.1, np.inf).astype(np.float32)
    *_, informative = kernels("mark_informative", (height * width,), status, deviation, height * width,
                         np.zeros((*shape, 2), np.float32))
    _, rows = kernels("sum_window", (width, height), informative, 2, width, height, 1, 0, np.zeros_like(informative))
    _, around = kernels("sum_window", (width, height), rows, 2, width, height, 0, 1, np.zeros_like(informative))
    _, depth, _, _, got, uninformative = kernels(
        "hold_uninformative", (height * width,), initial, refined.copy(), deviation, around, height * width, status,
        np.zeros(1, np.uint32))
    want, statuses = twin.hold_uninformative(initial.astype(np.float64), refined.astype(np.float64), status, deviation)
    assert np.abs(depth - want).max() < 1e-6 and (got == statuses).all()
    assert uninformative[0] == ((got == 2) & (status == 1)).sum() > 100
    between = (depth != initial) & (depth != refined)
    assert between.sum() > 100 and (depth == refined)[status == 1].sum() > 100


def test_verdicts_with_witnesses_equal_the_twin(device, without_holding):
    """The whole way: decided by two views, refused by either of two others, feathered, and judged by those."""
    rng = np.random.default_rng(5)
    scene = Scene.make(17, width=45, height=37, contexts=4, masks=True)
    config = CONFIG.with_settings(solver__max_move=2.0, solver__mismatch=0.8, solver__tolerance=0.1)
    level, depth_per_parallax, initial, normalized = entered_level(device, config, scene)
    judge, *held_out = (evidence_of(level, views, normalized) for views in ([1, 2], [3], [4]))
    refined = np.where(initial > 0, initial + rng.normal(0, 0.5, initial.shape) * depth_per_parallax,
                       0).astype(np.float32)

    def weighed(one):
        one.weigh()
        return [download(device, e, (*initial.shape, 3)).astype(np.float64) for e in (one.before, one.after)]

    cl.enqueue_copy(device.queue, level.buffers.depth, refined)
    alone = twin.decide(initial, refined, depth_per_parallax, *weighed(judge), 2.0, 0.1, 0.8)
    cl.enqueue_copy(device.queue, level.buffers.depth, np.where(alone == twin.REFINED, refined, initial))
    grown = [twin.worse(*weighed(one)) for one in held_out]
    cl.enqueue_copy(device.queue, level.buffers.depth, refined)
    decision = judge.decide(held_out)
    status = download(device, decision.status, initial.shape, np.uint8)
    accepted, judged = level.read("depth", initial.shape), [weighed(one) for one in held_out]
    level.release()
    one, other = (twin.refuse(alone, growth) for growth in grown)
    want = twin.refuse(one, grown[1])
    assert (want == twin.REFINED).sum() > 20 and all((want != fewer).sum() > 10 for fewer in (alone, one, other))
    assert (status == want).mean() > 0.999           # a sum next to 0 may fall either way
    feathered = twin.feather(initial.astype(np.float64), refined.astype(np.float64), status)
    assert np.abs(accepted - feathered).max() < 1e-6
    for medians, (before, after) in zip(decision.held_out, judged, strict=True):
        was, now, known = twin.costs(before, after)
        assert medians == pytest.approx((np.median(was[known]), np.median(now[known])), abs=0.01)


def _near(band):
    grown = np.pad(band, 2)
    return np.any([grown[y:y + band.shape[0], x:x + band.shape[1]] for y in range(5) for x in range(5)], axis=0)


def test_a_worse_depth_is_sent_back_bit_for_bit(device):
    from support.scenes import relief_scene

    from pagas_cl.method.splat import PhotoStore, ViewInput, refine_levels

    made = relief_scene(96, 72, 2)
    view, *others = made.views
    truth = made.true_depth(view.camera).astype(np.float32)
    steps = CONFIG.with_settings(pyramid__steps=(3,), solver__rate=3.0, solver__tolerance=0.0, solver__max_move=100.0)
    given = ViewInput(view, others, truth, device, PhotoStore(device))
    result = refine_levels(given, steps)       # steps of three pixels away from the truth
    rejected = result.status == 3
    assert rejected.mean() > 0.1
    assert (result.depth[rejected] == truth[rejected]).all()
    initial = made.initial_depth(view.camera).astype(np.float32)
    better = refine_levels(given.with_depth(initial), CONFIG.with_settings(pyramid__steps=(20,)))
    assert (better.depth != initial)[better.status == 1].mean() > 0.9
