"""Detail that photos do not support: what is taken back on the device against the twin, and where."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.scenes import relief_scene
from twins import mismatch as twin

from pagas_cl.config.presets import BALANCED, PAPER
from pagas_cl.method.effects.decide import decide_mismatch
from pagas_cl.method.splat import mismatch
from pagas_cl.method.splat.buffers import SampleGrid
from pagas_cl.method.view.one_view import refine_depth
from pagas_cl.runtime.memory import download
from pagas_cl.scene.camera import Size

pytestmark = pytest.mark.kernels


@pytest.fixture(scope="module")
def made():
    return relief_scene(96, 72, 3, held_out=0)


@pytest.fixture(scope="module")
def noisy(made):
    """Context views that err by themselves: each pixel of their photos is brighter or darker by a tenth."""
    rng = np.random.default_rng(0)
    return [replace(view, image=np.clip(view.load_image() * rng.normal(1, 0.1, (72, 96, 1)), 0, 255).astype(np.uint8))
            for view in made.views[1:]]


def refined(made, contexts, device, choice):
    config = BALANCED.with_settings(effects__mismatch=choice, effects__noise="off")
    return refine_depth(made.views[0], contexts, made.initial_depth(made.cameras[0]), device=device, config=config)


def test_equals_the_twin(device, made, noisy, monkeypatch):
    take_back, found, of_all = mismatch.take_back, [], []

    def spied(evidence, status, initial, always):
        def read(buffer, *more, dtype=np.float32):
            return download(device, buffer, (72, 96, *more), dtype).astype(np.float64)

        before = read(evidence.buffers.depth)
        given = (read(initial), before, read(evidence.buffers.depth_per_parallax), read(status, dtype=np.uint8),
                 read(evidence.of_accepted(evidence.views[:mismatch.VIEWS], mismatch.ROUNDING), 3)[..., 2]
                 * len(evidence.views) / mismatch.VIEWS)
        of_all.append(read(evidence.after, 3)[..., 2])
        read_mismatch = take_back(evidence, status, initial, always)
        found.append((read_mismatch(), before, read(evidence.buffers.depth), given))
        return read_mismatch

    monkeypatch.setattr(mismatch, "take_back", spied)
    result = refined(made, noisy, device, "on")
    ((noise_share, resolved), before, after, given), = found
    want, share = twin.taken_back(*given)
    ok, unit = given[3] == twin.REFINED, np.where(given[2] > 0, given[2], 1)
    assert SampleGrid.over(Size(96, 72)).stride == 2
    assert np.abs((after - want) / unit).max() < 1e-3 and np.abs((after - before) / unit).max() > 0.05
    np.testing.assert_array_equal(after[~ok], before[~ok])
    grid = np.s_[1::2, 1::2]
    assert noise_share == pytest.approx(np.median(share[grid][ok[grid]]), abs=0.02)
    bends = twin.resolved(before, given[3], np.maximum(given[4], of_all[0]))[grid]
    assert 0.01 < resolved == pytest.approx(np.quantile(bends[np.isfinite(bends)], 0.75), abs=0.02)
    assert result.report["resolved"] == resolved


def test_photos_that_match_are_refined_as_ever(device, made):
    found = {choice: refined(made, made.views[1:], device, choice) for choice in ("auto", "set", "on")}
    assert found["auto"].depth.tobytes() == found["set"].depth.tobytes() != found["on"].depth.tobytes()
    decision = {e["effect"]: e for e in found["auto"].report["effects"]}["mismatch"]
    assert not decision["on"] and decision["evidence"] < decision["threshold"]
    assert "mismatch" not in [e["effect"] for e in found["set"].report["effects"]]


def test_what_photos_that_do_not_match_left_is_smoother(device, made, noisy):
    errors, truth = [], made.true_depth(made.cameras[0])
    for choice in ("auto", "off"):
        result = refined(made, noisy, device, choice)
        errors.append(np.abs(result.depth - truth).mean())
        if choice == "auto":
            assert {e["effect"]: e for e in result.report["effects"]}["mismatch"]["on"]
    assert errors[0] < errors[1]


def test_nothing_is_measured_where_it_is_not_enabled():
    assert not mismatch.is_enabled(PAPER) and mismatch.is_enabled(BALANCED)
    assert not mismatch.is_enabled(BALANCED.with_settings(smoothness__kind="none"))
    assert not decide_mismatch(0.49, BALANCED).on and decide_mismatch(0.51, BALANCED).on
    assert decide_mismatch(0.1, BALANCED.with_settings(effects__mismatch="on")).on
