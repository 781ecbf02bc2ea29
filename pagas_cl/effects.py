"""Simulate only what the scene calls for (method section 8): from the measurements of a view, decide, and say why."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields, replace

import numpy as np

from pagas_cl.config import MOST_WEIGHT, Config, Effects
from pagas_cl.measurements import RULES, Measurements
from pagas_cl.splat.constants import SPECULAR_VIEW

MOST_RAISED = 40.0       # times the weight of the smoothness
SHINY_DISCONTINUITY = 0.6          # smoothness.discontinuity at least: what a highlight bends is no discontinuity
LOW_PASS = 0.06          # px^2: about what a photo's own pixel blurs; more than that blurs what is to be compared


@dataclass(frozen=True)
class Decision:
    """One effect: its evidence, the threshold, and whether it is simulated, with the reason."""

    effect: str
    evidence: float
    threshold: float
    on: bool
    reason: str

    def as_dict(self) -> dict:
        return asdict(self)

    def __str__(self) -> str:
        figures = f": {self.evidence:.3g}, threshold {self.threshold:g}" if self.evidence == self.evidence else ""
        return f"{self.effect} {'on' if self.on else 'off'} ({self.reason}{figures})"


def decide(config: Config, measured: Measurements | None) -> tuple[Config, list[Decision]]:
    """Settle every effect that is not "set": the settings that follow, and the decisions.

    Without measurements every effect must be "off" or "set".
    """
    decisions = [_decision(config, name, measured) for name in RULES if getattr(config.effects, name) != "set"]
    for decision in decisions:
        config = _SETTERS[decision.effect](config, decision, measured)
    keep = {f.name: "set" for f in fields(Effects) if f.name in RULES}
    return replace(config, effects=replace(config.effects, **keep)), decisions


def _decision(config: Config, name: str, measured: Measurements) -> Decision:
    attribute, threshold, above, what = RULES[name]
    evidence = float("nan") if measured is None else float(getattr(measured, attribute))
    choice = getattr(config.effects, name)
    called_for = evidence > threshold if above else evidence < threshold
    if name == "unseen_mask" and config.splatting.blend == "order_free":
        called_for, what = False, "the order-free blend compares only what is covered"
    on = choice == "on" or (choice == "auto" and called_for)
    return Decision(name, evidence, threshold, on, what if choice == "auto" else f"asked for: {choice}")


def _occlusion(config, decision, _):
    return config.with_settings(splatting__occlusion=decision.on)


def _unseen_mask(config, decision, _):
    return config.with_settings(loss__unseen_mask=decision.on)


def _exposure(config, decision, _):
    return config.with_settings(loss__exposure=decision.on)


def _view_dependence(config, decision, _):
    if not decision.on:
        return config.with_settings(loss__structure=False)
    return config.with_settings(loss__structure=True, loss__ssim=1.0,
                                smoothness__discontinuity=max(config.smoothness.discontinuity, SHINY_DISCONTINUITY))


def _antialiasing(config, decision, _):
    return config.with_settings(splatting__low_pass=LOW_PASS if decision.on else 0.0)


def _smoothness(config, decision, _):
    kind = config.smoothness.kind if config.smoothness.kind != "none" else "planar"
    return config.with_settings(smoothness__kind=kind if decision.on else "none")


def _pyramid(config, decision, _):
    if not decision.on:
        return config.with_settings(pyramid__scales=(1.0,), pyramid__steps=config.pyramid.steps[-1:])
    if len(config.pyramid.scales) > 1:
        return config
    steps = config.pyramid.steps[0]
    return config.with_settings(pyramid__scales=(0.25, 0.5, 1.0), pyramid__steps=(steps, steps, steps))


def _noise(config, decision, measured):
    """Noise-adaptive: the less of the photos a depth explains, the more its neighbours must agree, around what
    specularity there is, or everywhere; and where the photos are noisy, a first level of half size, where noise
    averages out."""
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


_SETTERS = {"occlusion": _occlusion, "unseen_mask": _unseen_mask, "exposure": _exposure,
            "view_dependence": _view_dependence, "antialiasing": _antialiasing, "smoothness": _smoothness,
            "pyramid": _pyramid, "noise": _noise}
