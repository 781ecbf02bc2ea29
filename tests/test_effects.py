"""What a scene needs: decisions on made-up measurements, the exposure fit, measurements of synthetic scenes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.effects import COMPILED
from support.effects import EFFECTS as CASES
from twins import exposure

from pagas_cl.config import Effects
from pagas_cl.config.presets import BALANCED, PAPER
from pagas_cl.errors import InputError
from pagas_cl.method.effects.decide import EFFECTS, LOW_PASS, WIDEST, decide, filter_between, left_to_smooth
from pagas_cl.method.effects.measure import Measurements, measure
from pagas_cl.method.splat import PhotoStore, ViewInput
from pagas_cl.method.view.coarse_to_fine import FAR_OFF

CALM = Measurements(**dict(overlap=1.0, far_off=0.0, misaligned=0.0, masked=False) | {
    name: value for effect in CASES.values() for name, value in effect.below.items()})
ALPHA = BALANCED.with_settings(splatting__blend="alpha")      # the blend that has every effect


def switched_on(config) -> dict[str, bool]:
    """Which effects the settings simulate."""
    return {name: effect.is_on(config) for name, effect in CASES.items()}


def calling_for(effect: str) -> Measurements:
    """Of a scene that needs one effect, and for smoothness, without which noise has nothing to weigh."""
    return replace(CALM, **{"textureless": 0.5, **CASES[effect].above})


def test_every_effect_has_an_entry():
    assert set(CASES) == set(EFFECTS) and all(effect.on and effect.off for effect in COMPILED.values())


@pytest.mark.parametrize("effect", EFFECTS)
def test_auto_follows_the_evidence(effect):
    assert not switched_on(decide(ALPHA, CALM)[0])[effect]
    measured = calling_for(effect)
    config, decisions = decide(ALPHA, measured)
    assert switched_on(config)[effect]
    decision = next(d for d in decisions if d.effect == effect)
    assert decision.on and decision.threshold == EFFECTS[effect].threshold
    assert decision.evidence == pytest.approx(getattr(measured, EFFECTS[effect].evidence))


@pytest.mark.parametrize("effect", EFFECTS)
def test_one_effect_alone_is_switched_on(effect):
    """But for smoothness, without which noise has nothing to weigh; noise also follows the measured specularity."""
    measured = calling_for(effect)
    on = {name for name, value in switched_on(decide(ALPHA, measured)[0]).items() if value}
    assert on - ({"noise"} if effect == "view_dependence" else set()) == {effect, "smoothness"}


@pytest.mark.parametrize("effect", EFFECTS)
def test_off_and_on_hold_against_the_evidence(effect):
    measured = calling_for(effect)
    off, decisions = decide(ALPHA.with_settings(**{f"effects__{effect}": "off"}), measured)
    assert not switched_on(off)[effect]
    assert "requested: off" in {d.reason for d in decisions}
    on = decide(ALPHA.with_settings(**{f"effects__{effect}": "on"}), replace(CALM, textureless=0.5))[0]
    if effect != "noise":         # on, it follows the noise that was measured: here there is none
        assert switched_on(on)[effect]


@pytest.mark.parametrize("effect", EFFECTS)
def test_set_leaves_the_settings_alone(effect):
    for base in (ALPHA, PAPER):
        given = base.with_settings(**{f"effects__{effect}": "set"})
        config, decisions = decide(given, replace(CALM, **CASES[effect].above))
        assert switched_on(config)[effect] == switched_on(base)[effect]
        assert effect not in {d.effect for d in decisions}


def test_all_set_needs_no_measurements_and_changes_nothing():
    config, decisions = decide(PAPER, None)
    assert config == PAPER and decisions == []


def test_decisions_are_final():
    """What comes out says "set", so that nothing is decided twice."""
    config, decisions = decide(BALANCED, CALM)
    assert all(getattr(config.effects, name) == "set" for name in EFFECTS)
    assert decide(config, None) == (config, [])
    assert all(set(d.as_dict()) == {"effect", "evidence", "threshold", "on", "reason"} for d in decisions)


def test_noise_raises_the_weight_and_never_lowers_it():
    weights = [decide(BALANCED, replace(CALM, textureless=0.5, noise=n))[0].smoothness.weight
               for n in (0.001, 0.01, 0.02, 1.0)]
    assert weights[0] == BALANCED.smoothness.weight
    assert weights[0] < weights[1] < weights[2] <= weights[3] <= 100


def test_photos_that_are_off_match_at_other_pixels_whatever_the_depth():
    off, right = (replace(CALM, far_off=0.1, misaligned=m).depth_far_off for m in (1.0, 0.1))
    assert off == 0 and right == pytest.approx(0.098)


def test_gloss_is_not_judged_through_a_depth_that_is_far_off():
    assert replace(CALM, specularity=0.5, far_off=0.5).residual == 0
    assert replace(CALM, specularity=0.5, far_off=0.25).residual == 0.5
    assert decide(BALANCED, replace(CALM, smallest=0.2))[0].splatting.low_pass == LOW_PASS


def test_between_rounds_smoothness_weighs_what_averages_leave_and_photos_do_not_explain():
    anew = replace(CALM, mismatched=0.09, local_specularity=np.zeros((2, 2), np.float32))
    clear, near = left_to_smooth([], 5, CALM), replace(anew, mismatched=0.02)
    assert clear == pytest.approx(0.3 + 0.7 / 3) == left_to_smooth([], 5, near) and left_to_smooth([], 1, None) == 1
    assert left_to_smooth([], 5, anew) == pytest.approx(3 * clear)
    assert left_to_smooth(decide(BALANCED, replace(anew, specularity=0.02))[1], 5, anew) == 1


def test_between_rounds_the_filter_is_wide_where_photos_resolve_less_than_averages_leave():
    assert [filter_between(resolved, 1, BALANCED) for resolved in (0.0, 1.0, 2.5, 3.5, 9.0)] == [WIDEST, 8, 4, 2, 2]
    assert filter_between(2.5 / (0.3 + 0.7 / 3), 5, BALANCED) == 4      # of six maps
    unknown, wide = float("nan"), BALANCED.with_settings(solver__gradient_filter=12)
    assert filter_between(unknown, 5, BALANCED) == 2 and filter_between(0.0, 5, wide) == 12
    assert filter_between(0.0, 5, BALANCED.with_settings(effects__agreement="set")) == 2


def test_unknown_choice_is_refused():
    with pytest.raises(InputError, match="effects.exposure is 'maybe'"):
        Effects(exposure="maybe")


def colours(number=2000, seed=0):
    return np.random.default_rng(seed).uniform(0.1, 0.6, (number, 3))


def test_exposure_fit_finds_gain_and_offset():
    own, rng = colours(), np.random.default_rng(1)
    truth = np.array([[1.3, 0.02], [0.8, -0.03], [1.0, 0.05]])
    other = own * truth[:, 0] + truth[:, 1] + rng.normal(0, 0.01, own.shape)
    other[:300] = rng.uniform(0, 1, (300, 3))                 # hidden there, or moved
    assert np.abs(exposure.fit(own, other) - truth).max() < 0.05


def test_exposure_fit_says_nothing_of_too_few_samples():
    own = colours(40)
    assert (exposure.fit(own, own * 1.5) == [[1, 0]] * 3).all()
    assert (exposure.fit(own[:0], own[:0]) == [[1, 0]] * 3).all()


def test_exposure_fit_of_one_colour_is_the_ratio():
    own = np.full((500, 3), 0.4)
    a, b = exposure.fit(own, own * 1.2)[0]
    assert a * 0.4 + b == pytest.approx(0.48, abs=1e-6)
    assert 0.9 < a < 1.4


def measured_of(device, **settings) -> Measurements:
    from support.scenes import relief_scene

    made = relief_scene(120, 90, 3, held_out=0, **settings)
    target, *contexts = made.views
    given = ViewInput(target, contexts, made.initial_depth(made.cameras[0]), device, PhotoStore(device))
    return measure(given, BALANCED)


@pytest.mark.slow
def test_measurements_keep_made_scenes_apart(device):
    clean = measured_of(device, steps=0)
    assert clean.overlap > 0.9 and clean.hidden <= EFFECTS["occlusion"].threshold and clean.far_off < 0.05
    assert clean.exposure_change < 0.012 and not clean.masked
    assert clean.smallest == pytest.approx(0.5, abs=0.1)
    jitter = measured_of(device, steps=0, exposure=0.3)
    assert jitter.exposure_change > 0.012
    assert measured_of(device, bar=10.0).hidden > clean.hidden + EFFECTS["occlusion"].threshold
    assert measured_of(device, steps=0, coarse_error=4.0).depth_far_off > FAR_OFF
    assert measured_of(device, steps=0, distances=(2.5,)).smallest < 0.36
    noisy = measured_of(device, steps=0, contrast=0.2, noise=6.0)
    assert noisy.noise > 0.01 and noisy.unexplained > 1.4


def test_without_surface_nothing_is_measured(device):
    from support.scenes import relief_scene

    made = relief_scene(64, 48, 2, held_out=0)
    target, *contexts = made.views
    nothing = ViewInput(target, contexts, np.zeros((48, 64), np.float32), device, PhotoStore(device))
    measured = measure(nothing, BALANCED)
    assert measured.overlap == 0 and measured.hidden == 0 and measured.far_off == 0


def test_an_effect_that_is_off_is_in_no_program():
    pytest.importorskip("pyopencl")
    from types import SimpleNamespace

    from pagas_cl.method.splat.options import defines

    config = decide(ALPHA.with_settings(**{f"effects__{name}": "off" for name in EFFECTS}), CALM)[0]
    macros = set(defines(config, SimpleNamespace(has=lambda extension: True), 200))
    switches = {effect.macros[0] for effect in COMPILED.values()}
    assert not macros & switches
    on = decide(ALPHA.with_settings(**{f"effects__{name}": "on" for name in EFFECTS}), CALM)[0]
    assert switches <= set(defines(on, SimpleNamespace(has=lambda extension: True), 200))
