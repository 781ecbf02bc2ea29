"""Simulate only what the scene needs (method section 8): from the measurements of a view, decide, and say why; and
whether refined views that contradict each other are cleaned before they are fused."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from pagas_cl.config import Config
from pagas_cl.config.stages import MOST_RAISED, MOST_WEIGHT
from pagas_cl.errors import log
from pagas_cl.method.effects.measure import Measurements, measure
from pagas_cl.method.splat import ViewInput, relit_views
from pagas_cl.method.splat.constants import NOISY_DETAIL, SPECULAR_VIEW
from pagas_cl.method.surface.agree import contradicted
from pagas_cl.method.surface.agreement import IN_COMMON

DIFFERENT = 0.02         # pixels of parallax by which refined depth maps differ, from which on photos have steps
                         # between rounds: less no photo resolves
AGREEMENT_ROUNDS = 2     # each averages; between them, and not after the last, the photos have some steps
MATCHED = 0.03           # share of a patch's variance that photos may leave unexplained for the default smoothness
WIDEST, WELL_RESOLVED = 8, 5.0      # pixels of the filter between rounds; `resolved` of which one is enough
CONTRADICTED = 0.04      # share of depths that others contradict, above which those are left out of a fusion
BADLY_MATCHED = 0.02     # share of pixels where photos match badly, from which on other depths are tried there: less is
                         # edges; and of those where one is clearly better, above which steps go on from them: starts
FAR_FOUND = 0.003        # that are near have up to 0.0012 on made scenes, far ones 0.007 or more
AFTER_HYPOTHESES = 0.33  # share of the steps of full size that follow
SHADED = 0.02            # mean residual: highlights leave 0.009 to 0.0195 on made scenes, shading, haze 0.028 or more
_BEFORE_RELIT = ("shading", "view_dependence")       # effects that photos as they are decide
SHINY_DISCONTINUITY = 0.6  # smoothness.discontinuity at least: what a highlight bends is no discontinuity
LOW_PASS = 0.06          # px^2: about what a photo's own pixel blurs; more than that blurs what is to be compared


@dataclass(frozen=True)
class Decision:
    """One effect: its evidence, the threshold, and whether it is simulated, with the reason."""

    effect: str
    evidence: float
    threshold: float
    on: bool
    reason: str

    @classmethod
    def of(cls, effect: str, config: Config, evidence: float, threshold: float, needed: bool,
           description: str) -> Decision:
        """On if it is requested, or, where it is to be decided, `needed`, for the reason that `description` says."""
        choice = getattr(config.effects, effect)
        if choice == "auto":
            return cls(effect, evidence, threshold, needed, description)
        return cls(effect, evidence, threshold, choice == "on", f"requested: {choice}")

    def as_dict(self) -> dict:
        return dict(vars(self))

    def __str__(self) -> str:
        figures = "" if np.isnan(self.evidence) else f": {self.evidence:.3g}, threshold {self.threshold:g}"
        return f"{self.effect} {'on' if self.on else 'off'} ({self.reason}{figures})"


def add_decision(report: dict, decision: Decision | None) -> None:
    """Note in a result's report what was decided of an effect, in place of what was before; None: nothing was."""
    new = [decision.as_dict()] if decision else []
    report["effects"] = [old for old in report.get("effects", ()) if not new or old["effect"] != decision.effect] + new


_Resolved = tuple[Config, list[Decision], Measurements | None, ViewInput]   # what `resolve_effects` gives


def _sets(key: str, on=True, off=False):
    """What sets one setting to `on` or `off`."""
    return lambda config, decision, _: config.with_settings(**{key: on if decision.on else off})


def _view_dependence(config, decision, _):
    if not decision.on:
        return config.with_settings(loss__structure=False)
    return config.with_settings(loss__structure=True, loss__ssim=1.0,
                                smoothness__discontinuity=max(config.smoothness.discontinuity, SHINY_DISCONTINUITY))


def _smoothness(config, decision, _):
    kind = config.smoothness.kind if config.smoothness.kind != "none" else "planar"
    return config.with_settings(smoothness__kind=kind if decision.on else "none")


def _noise(config, decision, measured):
    """Noise-adaptive: the less of the photos a depth explains, the more its neighbours must agree; and where photos are
    noisy, a first level of half size, where noise averages out."""
    if not decision.on:
        return config
    if (measured is None or measured.relative_noise > decision.threshold) and len(config.pyramid.scales) == 1:
        config = config.with_settings(pyramid__scales=(0.5, 1.0), pyramid__steps=2 * config.pyramid.steps)
    if config.smoothness.kind == "none":
        return config
    factor = float(np.clip(measured.unexplained_everywhere**2, 1.0, MOST_RAISED)) if measured else 4.0
    specular = measured and measured.residual > SPECULAR_VIEW
    return config.with_settings(smoothness__weight=min(config.smoothness.weight * factor, MOST_WEIGHT),
                                smoothness__specularity=MOST_RAISED if specular else 0.0)


def _moot_where_order_free(config):
    return "the order-free blend compares only what is covered" if config.splatting.blend == "order_free" else ""


@dataclass(frozen=True)
class Effect:
    """When a view needs an effect, and what follows: `evidence` is an attribute of Measurements, which the report calls
    `description`; `above`: whether evidence above the threshold speaks for the effect, or below it; `apply` gives the
    settings with the effect on or off, as decided; `moot`: why settings do without it, whatever is measured."""

    evidence: str
    threshold: float
    above: bool
    description: str
    apply: Callable[[Config, Decision, Measurements | None], Config]
    moot: Callable[[Config], str] = lambda config: ""


EFFECTS = {
    "occlusion": Effect("hidden", 0.002, True, "share of Gaussians hidden by a nearer surface",
                        _sets("splatting__occlusion")),
    "unseen_mask": Effect("unseen", 0.02, True, "share of a context photo that the target does not reach",
                          _sets("loss__unseen_mask"), _moot_where_order_free),
    "exposure": Effect("exposure_change", 0.012, True, "difference of colour between photos (0 to 1)",
                       _sets("loss__exposure")),
    "view_dependence": Effect("residual", 0.035, True, "residual left after exposure (0 to 1)", _view_dependence),
    "shading": Effect("shading", SHADED, True, "mean residual left after exposure (0 to 1)", _sets("loss__shading")),
    "antialiasing": Effect("smallest", 0.36, False, "smallest projected Gaussian, pixels",
                           _sets("splatting__low_pass", LOW_PASS, 0.0)),
    "smoothness": Effect("textureless", 0.01, True, "share of pixels with little texture", _smoothness),
    "noise": Effect("unexplained", 1.4, True,
                    "noise, residual, cameras that are off; of what the default weight allows for", _noise),
}


def decide(config: Config, measured: Measurements | None) -> tuple[Config, list[Decision]]:
    """Resolve every effect that is not "set": the settings that follow, and the decisions. Without measurements every
    effect must be "off" or "set"."""
    decisions = [_decision(config, name, measured) for name in EFFECTS if getattr(config.effects, name) != "set"]
    for decision in decisions:
        config = EFFECTS[decision.effect].apply(config, decision, measured)
    return replace(config, effects=replace(config.effects, **dict.fromkeys(EFFECTS, "set"))), decisions


def _decision(config: Config, name: str, measured: Measurements) -> Decision:
    effect = EFFECTS[name]
    evidence = float("nan") if measured is None else float(getattr(measured, effect.evidence))
    needed, moot = evidence > effect.threshold if effect.above else evidence < effect.threshold, effect.moot(config)
    return Decision.of(name, config, evidence, effect.threshold, needed and not moot, moot or effect.description)


@contextmanager
def resolve_effects(given: ViewInput, config: Config, known: Measurements | None = None) -> Iterator[_Resolved]:
    """Decide which effects this view needs: context of the settings that follow, the decisions, what they rest on, and
    the view, its context views relit where shading is on; its photos let go of those at its end. `known`: what was
    measured beforehand."""
    found = _resolved(given, config, known)
    try:
        yield found
    finally:
        given.photos.forget(set(found[3].contexts) - set(given.contexts))


def _resolved(given: ViewInput, config: Config, known: Measurements | None = None) -> _Resolved:
    if config.effects.shading == "on" or (config.effects.shading == "set" and config.loss.shading):
        given = replace(given, contexts=relit_views(given, config))
    if not config.effects.measured:
        resolved, decisions = decide(config, None)
        return resolved, decisions, None, given
    measured = known or measure(given, config)
    resolved, decisions = decide(config, measured)
    if config.effects.shading == "auto" and resolved.loss.shading:      # what else is needed, relit photos show
        first = {decision.effect: decision for decision in decisions if decision.effect in _BEFORE_RELIT}
        resolved, decisions, measured, given = _resolved(given, shaded(config))
        return resolved, [first.get(decision.effect, decision) for decision in decisions], measured, given
    for decision in decisions:
        log.debug("view %s: %s", given.target.name, decision)
    return resolved, decisions, measured, given


def shaded(config: Config) -> Config:
    """Settings of a view whose photos are relit: structure alone is compared, whatever they still differ by."""
    settings = {"effects__view_dependence": "on"} if config.effects.view_dependence == "auto" else {}
    return config.with_settings(effects__shading="on", **settings)


def least_found(config: Config) -> tuple[float, float]:
    """Shares of pixels that must match badly for other depths to be tried, and better for the search to go on."""
    return (0.0, 0.0) if config.effects.hypotheses == "on" else (BADLY_MATCHED, FAR_FOUND)


def decide_hypotheses(evidence: float, config: Config) -> Decision:
    """Whether steps go on from depths that were found along the ray, at which share of pixels."""
    decision = Decision.of("hypotheses", config, evidence, FAR_FOUND, evidence > FAR_FOUND,
                           "share of pixels where other depths match clearly better")
    return replace(decision, on=decision.on and evidence > 0)


@lru_cache(8)
def at_full_size(config: Config, share: float) -> Config:
    """The settings of some more steps at full size: a share of the last level's."""
    return config.with_settings(pyramid__scales=(1.0,), pyramid__steps=(
        max(1, round(share * config.pyramid.steps[-1])),))


def decide_mismatch(evidence: float, config: Config) -> Decision:
    """What share of the refined detail is noise, and whether it was taken back (splat.mismatch)."""
    return Decision.of("mismatch", config, evidence, NOISY_DETAIL, evidence > NOISY_DETAIL,
                       "refined detail that is noise by how photos match")


def agreement_rounds(config: Config, views: int) -> int:
    """How many rounds of agreement so many refined views may have; each view's own decision is decide_agreement."""
    choice = config.effects.agreement
    if choice == "off" or views < 2:
        return 0
    return config.agreement.rounds if choice == "set" else config.agreement.rounds or AGREEMENT_ROUNDS


def between_rounds(config: Config) -> Config | None:
    """The settings of the steps that photos have between two rounds, at full size; None where they have none."""
    share = config.agreement.steps
    return at_full_size(config, share) if share else None


def left_to_smooth(decisions: Sequence[Decision], others: int, measured: Measurements | None) -> float:
    """What smoothness has left to do in a mean with so many others, unless noise has set it: the share of its variance
    that such an average leaves, times what photos do not explain, where it was measured anew."""
    if any(decision.effect == "noise" and decision.on for decision in decisions):
        return 1.0
    mismatched = 0.0 if measured is None or measured.local_specularity is None else measured.mismatched
    return left_by_mean(others) * max(1.0, mismatched / MATCHED)


def left_by_mean(others: int) -> float:
    """Share of the variance of a depth that its mean with those of so many others leaves (agreement.cl)."""
    return IN_COMMON + (1 - IN_COMMON) * min(1.0, 2 / (others + 1))


def filter_between(resolved: float, others: int, config: Config) -> int:
    """solver.gradient_filter of the steps after a mean with so many others: wider, the less photos resolve of the bends
    that the mean leaves (`resolved`, EvidenceDecision); as it is where that is not known."""
    if config.effects.agreement == "set" or np.isnan(resolved):
        return config.solver.gradient_filter
    pixels = (WELL_RESOLVED / max(resolved * left_by_mean(others), 0.1)) ** 2
    return max(config.solver.gradient_filter, round(min(WIDEST, pixels)))


def decide_agreement(spread: float, config: Config) -> Decision:
    """Whether a view is averaged with others, whose depth maps differ by `spread`, NaN: there are none to speak of."""
    decision = Decision.of("agreement", config, spread, 0.0, True,
                           "difference of refined depth maps, pixels of parallax")
    return replace(decision, on=not np.isnan(spread))


def needs_steps(spread: float, config: Config) -> bool:
    """Whether a view is averaged before the last round, too, and then has steps of the photos."""
    return config.effects.agreement != "auto" or spread > DIFFERENT


def decide_consistency(cameras, depths, config: Config, device=None) -> tuple[Config, Decision | None]:
    """Resolve effects.consistency: fusion.agree_views as it follows, and the decision (None where it is "set").
    `depths` are those to be fused, one a camera: an ndarray of shape (H, W), a DepthResult, something with load(), or
    None. They are compared on `device`, in NumPy by default."""
    choice, share, why = config.effects.consistency, float("nan"), "it takes three views to find which is wrong"
    if choice == "set" or (choice == "auto" and config.fusion.agree_views > 0):
        return config, None
    have = [k for k, depth in enumerate(depths) if depth is not None]
    if choice == "auto" and len(have) >= 3:
        share = contradicted([cameras[k] for k in have], [depths[k] for k in have], config.fusion.agree_pixels, device)
        why = "share of depths that other views contradict"
    decision = Decision.of("consistency", config, share, CONTRADICTED, share > CONTRADICTED, why)
    return config.with_settings(fusion__agree_views=(config.fusion.agree_views or 1) if decision.on else 0,
                                effects__consistency="set"), decision
