"""Photos that do not match: what is measured on the device against the twin, and what follows for the smoothness."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.kernel_cases import Scene, start_level
from support.scenes import relief_scene
from twins import mismatch as twin

from pagas_cl.config import MOST_RAISED, MOST_WEIGHT, Smoothness
from pagas_cl.effects import decide_mismatch
from pagas_cl.presets import BALANCED, PAPER
from pagas_cl.refine import refine_depth
from pagas_cl.runtime.memory import download
from pagas_cl.splat import mismatch
from pagas_cl.splat.buffers import SampleGrid
from pagas_cl.splat.measure import Rows

pytestmark = pytest.mark.kernels


def test_samples_equal_the_twin(device, monkeypatch):
    scene, kept = Scene.make(5, width=45, height=37, contexts=2), []
    level = start_level(device, BALANCED, scene)
    summarize = Rows.summarize
    monkeypatch.setattr(Rows, "summarize", lambda rows: kept.append(rows) or summarize(rows))
    mismatch.measured(level)
    grid, (rows,) = SampleGrid.over(level.target.size), kept
    got = 2.0 ** download(device, rows.values, (rows.rows, rows.count))
    parallax, kappa = (level.read(name, scene.moved.shape).astype(np.float64)
                       for name in ("depth_per_parallax", "kappa"))
    level.release()
    at = tuple(axis.ravel() for axis in np.mgrid[:37, :45])
    assert grid.stride == 1
    depth = scene.moved.astype(np.float64)
    want = [*twin.bends(depth, kappa, at, twin.NEAR_BY), *twin.bends(depth, kappa, at, 2 * twin.NEAR_BY)]
    for mine, theirs in zip(got[:4], want):
        assert (np.isfinite(mine) == np.isfinite(theirs)).mean() > 0.999
        np.testing.assert_allclose(mine, theirs, rtol=2e-2, atol=1e-4 * np.nanmax(theirs))
    for mine, context in zip(got[4:], scene.contexts):
        theirs = twin.match(depth, parallax, scene.target, context, scene.scene_scale, at)
        both = np.isfinite(mine) & np.isfinite(theirs)
        assert both.sum() > 50 and (np.isfinite(mine) == np.isfinite(theirs)).mean() > 0.97
        off = np.abs(mine / theirs - 1)[both]
        assert np.median(off) < 1e-3 and np.quantile(off, 0.95) < 0.1


def test_balance_of_errors_and_bending():
    """Errors that the photos allow and that do not grow as a surface's bending does raise it; either alone does not."""
    assert mismatch.balance(1.0, 5.0, 1.0) == mismatch.balance(1.0, 9.6, 1.0) == mismatch.balance(1.0, 2.0, 0.0) == 0
    assert mismatch.balance(1.0, 2.0, 1.0) == MOST_RAISED
    some = [mismatch.balance(1.0, growth, 1.0) for growth in (4.8, 4.0, 3.5, 2.5)]
    assert some == sorted(some) and some[0] < 1 < some[1]
    scaled = mismatch.balance(1e-4, 4e-4, 1e-4)
    assert scaled == pytest.approx(mismatch.balance(1.0, 4.0, 1.0))
    one, much = (Smoothness(weight=weight, full_views=1).weight_with for weight in (0.12, 90.0))
    assert one(5, 0.3) == one(5, float("nan")) == 0.12
    assert one(5, 2.0) == 0.24 and much(5, 2.0) == MOST_WEIGHT


@pytest.fixture(scope="module")
def made():
    return relief_scene(96, 72, 3, held_out=0)


def test_photos_that_match_are_refined_as_ever(device, made):
    depth = made.initial_depth(made.cameras[0])
    found = {choice: refine_depth(made.views[0], made.views[1:], depth, device=device, config=BALANCED.with_settings(
        effects__mismatch=choice)) for choice in ("auto", "set")}
    assert found["auto"].depth.tobytes() == found["set"].depth.tobytes()
    told = {e["effect"]: e for e in found["auto"].report["effects"]}["mismatch"]
    assert not told["on"] and told["evidence"] < told["threshold"] == 1
    assert "mismatch" not in [e["effect"] for e in found["set"].report["effects"]]


def test_photos_that_do_not_match_are_smoothed_more(device, made):
    """Errors that only the photos have: each pixel of the context photos is brighter or darker by a tenth."""
    rng, depth = np.random.default_rng(0), made.initial_depth(made.cameras[0])
    off = [replace(view, image=np.clip(view.load_image() * rng.normal(1, 0.1, (72, 96, 1)), 0, 255).astype(np.uint8))
           for view in made.views[1:]]
    errors = []
    for choice in ("auto", "off"):
        config = BALANCED.with_settings(effects__mismatch=choice, effects__noise="off")
        result = refine_depth(made.views[0], off, depth, device=device, config=config)
        errors.append(np.abs(result.depth - made.true_depth(made.cameras[0])).mean())
        if choice == "auto":
            assert {e["effect"]: e for e in result.report["effects"]}["mismatch"]["on"]
    assert errors[0] < errors[1]


def test_nothing_is_measured_where_it_is_not_asked_for():
    assert not mismatch.is_asked(PAPER) and mismatch.is_asked(BALANCED)
    assert not mismatch.is_asked(BALANCED.with_settings(smoothness__kind="none"))
    assert not decide_mismatch(0.9, BALANCED).on and decide_mismatch(1.1, BALANCED).on
