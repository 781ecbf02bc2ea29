"""Refined depth maps as evidence for one another: the kernel against its twin, exact surfaces, edges, whole runs."""

import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from conftest import plane_depth
from support.job_scenes import QUICK, bytes_of, load_small_scene, said, write_small_scene
from twins import agreement as twin

from pagas_cl.config.presets import preset
from pagas_cl.method.effects import decide
from pagas_cl.method.effects.decide import decide_agreement, filter_between, needs_steps
from pagas_cl.method.surface.agreement import Agreement, send
from pagas_cl.method.view import rounds
from pagas_cl.method.view.rounds import average_and_step, average_depths, later_rounds
from pagas_cl.refine import refine_views
from pagas_cl.result import DepthResult
from pagas_cl.runtime.memory import download, upload
from pagas_cl.scene.depthmap import KEPT, REFINED, REJECTED

NORMAL = np.array([0.3, 0.2, -0.93]) / np.linalg.norm([0.3, 0.2, -0.93])
PIXEL = np.float32(0.05)          # of parallax, about, in the ring's units


def evidence(camera, depth, deviation=0.01, status=REFINED):
    def filled(value, dtype):
        return np.full(depth.shape, value, dtype)

    return DepthResult(camera, depth, filled(status, "u1"), filled(deviation, "f4"), filled(PIXEL, "f4"))


def trusted(view):
    """Its depths that photos confirm, 0 for all others."""
    return np.where((view.status == REFINED) & (view.depth > 0) & np.isfinite(view.deviation), view.depth, 0.0)


def averaged(comparison, *given):
    found = comparison.average(*given)
    into = {name: np.empty_like(getattr(comparison.own, name)) for name in found}
    return replace(comparison.own, **comparison.read(found, into))


@pytest.fixture
def planes(ring):
    """What seven views say of one plane."""
    return [evidence(camera, plane_depth(camera, NORMAL, 0)) for camera in ring]


def noisy(view, rng, size=0.3):
    shape = view.depth.shape
    return replace(view, depth=(view.depth + size * PIXEL * rng.normal(size=shape)).astype("f4"),
                   deviation=(PIXEL * rng.uniform(0.02, 0.8, shape)).astype("f4"))


@pytest.mark.kernels
def test_the_device_equals_the_twin(planes, device):
    rng = np.random.default_rng(0)
    views = [noisy(view, rng) for view in planes]
    for view in views:
        view.depth[rng.uniform(size=view.depth.shape) < 0.01] = 0
        view.deviation[rng.uniform(size=view.depth.shape) < 0.01] = np.inf
        view.status[rng.uniform(size=view.depth.shape) < 0.1] = REJECTED
    views[1].depth[30:60, 20:90] *= np.float32(0.8)                       # something in front
    own, others = views[3], views[:3] + views[4:6]
    comparison = Agreement(own, others, device)
    d, u = own.depth.astype(float), own.parallax.astype(float)
    differences = [twin.difference(own.camera, d, u, o.camera, trusted(o), o.deviation.astype(float)) for o in others]
    apart = np.concatenate([(np.abs(change) / u)[trusted(own) > 0] for change, _ in differences])
    spread = comparison.spread()
    assert spread == pytest.approx(np.median(apart[apart < 4]) / 0.6745 / 2**0.5, abs=1e-3) and 0.2 < spread < 0.4
    got = averaged(comparison, spread, 2.0, True, 0.4)
    want = twin.average(d, own.deviation, u, own.status, differences, spread, 2.0, 0.4)
    near = np.abs(got.depth - want[0]) < 1e-5          # what an edge of a cell decides may fall otherwise
    assert near.mean() > 0.999 and (got.status == want[2]).mean() > 0.999
    known = (twin.summed_around(~near) == 0) & np.isfinite(want[1])     # which goes into the deviations around
    assert known.mean() > 0.95
    assert np.allclose(got.deviation[known], want[1][known], rtol=1e-3) and (want[0] != d).mean() > 0.5
    again = averaged(Agreement(own, others, device), spread, 2.0, True, 0.4)
    assert again.depth.tobytes() == got.depth.tobytes() and again.deviation.tobytes() == got.deviation.tobytes()


@pytest.mark.kernels
def test_an_exact_plane_is_met_exactly(planes, device):
    """However steep, and however far off along the ray: no fixed point is iterated to."""
    own = replace(planes[3], depth=planes[3].depth + np.float32(1.5) * PIXEL)
    comparison = Agreement(own, planes[:3] + planes[4:], device)
    found = averaged(comparison, comparison.spread(), 4.0)
    alone = replace(own, status=np.full_like(own.status, REJECTED))
    others = averaged(Agreement(alone, planes[:3] + planes[4:], device), 0.1, 4.0)
    seen = others.status == REFINED
    assert seen.mean() > 0.9 and np.abs(others.depth - planes[3].depth)[seen].max() < 2e-5
    middle = np.s_[40:80, 60:100]
    assert np.abs(found.depth - planes[3].depth)[middle].max() < 0.5 * PIXEL


@pytest.mark.kernels
def test_noise_averages_and_deviations_shrink(planes, device):
    rng = np.random.default_rng(1)
    views = [noisy(view, rng) for view in planes]
    found = averaged(Agreement(views[3], views[:3] + views[4:], device), 0.3, 2.0)
    error = [np.std((view.depth - planes[3].depth) / PIXEL) for view in (views[3], found)]
    assert error[1] < 0.6 * error[0]
    s = views[3].deviation
    assert np.median(found.deviation) < np.median(s) and (found.deviation > 0.05 * PIXEL).all()


@pytest.mark.kernels
def test_other_surfaces_say_nothing(planes, device):
    """Something in front, depths that photos refused, depth edges, no depth at all, too far away to be the same."""
    own, middle = planes[3], np.s_[50:70, 70:90]

    def changed(**arrays):
        view = replace(planes[2], **{name: getattr(planes[2], name).copy() for name in arrays})
        for name, value in arrays.items():
            getattr(view, name)[...] = value
        nearly = replace(own, depth=own.depth + np.float32(0.1) * PIXEL)
        return averaged(Agreement(nearly, [view], device), 0.1, 2.0)

    stripes = planes[2].depth + 4 * PIXEL * (np.arange(160) % 2)
    before = own.depth + np.float32(0.1) * PIXEL
    for arrays in ({"depth": planes[2].depth - 10 * PIXEL}, {"status": REJECTED}, {"depth": 0}, {"deviation": np.inf},
                 {"depth": stripes}):
        found = changed(**arrays)
        assert np.array_equal(found.depth[middle], before[middle]), arrays
        assert np.array_equal(found.deviation, own.deviation)
    assert not np.array_equal(changed().depth[middle], before[middle])


@pytest.mark.kernels
def test_what_photos_refused_is_replaced_where_they_judge_it_anew(planes, device):
    status = planes[3].status.copy()
    status[50:70, 70:90] = REJECTED
    own = replace(planes[3], depth=planes[3].depth + np.float32(0.5) * PIXEL, status=status)
    comparison = Agreement(own, planes[:3], device)
    last, earlier = (averaged(comparison, 0.1, 2.0, propose) for propose in (False, True))
    assert (last.status == status).all() and (last.depth == own.depth)[50:70, 70:90].all()
    assert (earlier.status == REFINED).all() and (earlier.depth == last.depth)[status == REFINED].all()
    assert np.abs(earlier.depth - planes[3].depth)[50:70, 70:90].max() < 2e-5


@pytest.mark.kernels
def test_what_no_view_speaks_for_or_photos_refuse_stays_as_it_was(planes, device):
    """On the device, with what the next round compares with."""
    rng, shape = np.random.default_rng(4), planes[3].depth.shape
    proposed, status = (rng.choice(np.array([REFINED, REJECTED, KEPT], "u1"), shape) for _ in range(2))
    depth, parallax, deviation = (rng.uniform(1, 2, shape).astype("f4") for _ in range(3))
    own, comparison = planes[3], Agreement(planes[3], planes[:3], device)
    buffers = (upload(device, array) for array in (proposed, depth, parallax, deviation, status))
    maps = comparison.agreed(*buffers)
    held = (proposed == REFINED) & (status == REFINED)
    want = {"depth": np.where(held, depth, own.depth), "deviation": np.where(held, deviation, own.deviation),
            "status": np.where(held, status, own.status), "parallax": parallax}
    for name, array in want.items():
        assert np.array_equal(download(device, getattr(maps, name), shape, array.dtype), array), name
    sent = send(replace(own, **want), device)
    assert np.array_equal(*(download(device, given.inverse, shape) for given in (maps, sent)))


@pytest.mark.kernels
def test_what_has_no_parallax_is_left_alone(planes, device):
    own = replace(planes[3], parallax=np.zeros_like(planes[3].parallax), status=np.full_like(planes[3].status, KEPT))
    comparison = Agreement(own, planes[:3], device)
    assert np.isnan(comparison.spread())
    found = averaged(comparison, 0.1, 2.0)
    assert np.array_equal(found.depth, own.depth) and np.array_equal(found.status, own.status)


# -- rounds --------------------------------------------------------------------------------------------------------

ROUNDS = QUICK.with_settings(effects__agreement="on", agreement__steps=0.5)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return load_small_scene(write_small_scene(tmp_path_factory.mktemp("agreement") / "scene"))


@pytest.fixture(scope="module")
def wanted(scene):
    return refine_views(*scene, config=ROUNDS)


def same(results, wanted) -> bool:
    return all(getattr(a, name).tobytes() == getattr(b, name).tobytes() for a, b in zip(results, wanted, strict=True)
               for name in ("depth", "status", "deviation", "parallax"))


def test_rounds_are_reported(scene, wanted):
    assert not same(refine_views(*scene, config=QUICK), wanted)
    for result in wanted:
        assert len(result.report["differences"]) == 2 and result.report["effects"][-1]["effect"] == "agreement"


def test_maps_that_hardly_differ_are_averaged_once_and_have_no_steps(scene, wanted, monkeypatch):
    config = ROUNDS.with_settings(effects__agreement="auto")
    auto = refine_views(*scene, config=config)
    assert all(len(result.report["differences"]) == 1 for result in auto)
    assert same(auto, refine_views(*scene, config=ROUNDS.with_settings(agreement__rounds=1)))
    monkeypatch.setattr(decide, "DIFFERENT", 0.0)
    assert same(refine_views(*scene, config=config), wanted)


def test_steps_between_rounds_are_filtered_as_the_photos_need(scene, monkeypatch):
    refine_levels, seen = rounds.refine_levels, []

    def spied(*given, **named):
        seen.append((named["start"] is not None, given[1].solver.gradient_filter))
        return refine_levels(*given, **named)

    monkeypatch.setattr(rounds, "refine_levels", spied)
    want = [filter_between(result.report["resolved"], 3, ROUNDS) for result in refine_views(*scene, config=ROUNDS)]
    assert seen == [(True, radius) for radius in want] and max(want) > ROUNDS.solver.gradient_filter
    seen.clear()
    refine_views(*scene, config=ROUNDS.with_settings(effects__mismatch="off"))
    assert seen == [(True, ROUNDS.solver.gradient_filter)] * 8


def test_the_order_of_views_and_where_they_are_worked_on_do_not_matter(scene, wanted, tmp_path):
    views, depths = scene
    assert same(refine_views(views, depths, config=ROUNDS, folder=tmp_path / "kept"), wanted)
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        assert same(refine_views(views, depths, config=ROUNDS, executor=pool), wanted)
    order = [3, 0, 7, 1, 5, 2, 6, 4]
    finished = []
    results = refine_views([views[k] for k in order], [depths[k] for k in order], config=ROUNDS,
                           on_view=lambda view, depth, result: finished.append((view.name, result)))
    assert [name for name, _ in finished] == [views[k].name for k in order] and [r for _, r in finished] == results
    assert same(results, [wanted[k] for k in order])


def test_a_killed_run_goes_on_from_its_rounds(scene, wanted, tmp_path):
    def interrupt(stage, done, total):
        if stage == "agree, round 1" and done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        refine_views(*scene, config=ROUNDS, folder=tmp_path, progress=interrupt)
    assert not bytes_of(tmp_path) and len(bytes_of(tmp_path / ".pagas_cl" / "round_1")) == 3
    assert same(refine_views(*scene, config=ROUNDS, folder=tmp_path), wanted)
    assert not list((tmp_path / ".pagas_cl").glob("round_*"))      # nothing is kept twice
    assert same(refine_views(*scene, config=ROUNDS, folder=tmp_path), wanted)
    assert not said(tmp_path, "began") and not list((tmp_path / ".pagas_cl").glob("round_*/*.npz"))
    (tmp_path / "context_02.npz").unlink()
    stages = []
    refine_views(*scene, config=ROUNDS, folder=tmp_path,
                 progress=lambda stage, done, total: stages.append((stage, total)))
    assert said(tmp_path, "began") == ["context_02.png"] and ("agree, round 1", 4) in stages      # itself, its contexts


def test_effect_and_settings(scene):
    views, depths = scene
    off, on = (QUICK.with_settings(effects__agreement=choice) for choice in ("off", "on"))
    assert later_rounds(off, 9) == [] == later_rounds(on, 1)
    assert later_rounds(preset("fast"), 9) == [average_depths]
    assert later_rounds(on, 2) == [average_and_step, average_depths]
    assert len(later_rounds(preset("fast").with_settings(agreement__rounds=3), 2)) == 3
    auto = QUICK.with_settings(effects__agreement="auto")
    assert decide_agreement(0.1, auto).on and decide_agreement(0.01, auto).on and decide_agreement(0.001, on).on
    assert not decide_agreement(float("nan"), auto).on and not decide_agreement(float("nan"), on).on
    assert [needs_steps(spread, auto) for spread in (0.1, 0.01)] == [True, False] and needs_steps(0.001, on)
    one = refine_views(views, depths, names=["target"], config=on)
    assert same(one, refine_views(views, depths, names=["target"], config=off))
