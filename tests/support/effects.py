"""What the tests know of each effect, in one table: an effect that is new needs one entry here.

Read by tests of decisions (test_effects), of programs (test_effects_off, stripped), and of gradients
(reference_cases, test_kernels).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from pagas_cl.config import Config
from pagas_cl.config.presets import BALANCED


@dataclass(frozen=True)
class Effect:
    """One effect.

    Attributes
    ----------
    below, above : dict
        Measurements of a scene that does not call for it, and of one that does.
    is_on : callable
        Whether settings simulate it.
    on, off : dict
        Settings with all of its code, and with none; empty where no code stands behind a macro.
    macros : tuple of str
        What its code in the kernels of a step stands behind.
    parameters : tuple of str
        Parameters of those kernels that serve it alone.
    buffers : tuple of str
        Buffers of a level that are made for it.
    cases : dict
        Settings by name under which its gradient is tested: the twin's against central differences, the device's
        against the twin's.
    """

    below: dict[str, Any]
    above: dict[str, Any]
    is_on: Callable[[Config], bool]
    on: dict[str, Any] = field(default_factory=dict)
    off: dict[str, Any] = field(default_factory=dict)
    macros: tuple[str, ...] = ()
    parameters: tuple[str, ...] = ()
    buffers: tuple[str, ...] = ()
    cases: dict[str, dict[str, Any]] = field(default_factory=dict)


EFFECTS = {
    "occlusion": Effect(
        below=dict(hidden=0.0), above=dict(hidden=0.1),
        is_on=lambda config: config.splatting.occlusion,
        on=dict(splatting__occlusion=True, splatting__depth_relative=0.5),
        off=dict(splatting__occlusion=False),
        macros=("OCCLUSION", "DEPTH_RELATIVE"), parameters=("z_first", "depth_threshold", "depth_relative"),
        buffers=("z_first", "surfaces0", "surfaces1"),
        cases={"order-free no occlusion": dict(splatting__occlusion=False),
               "order-free relative": dict(splatting__depth_relative=0.01)}),
    "unseen_mask": Effect(
        below=dict(unseen=0.0), above=dict(unseen=0.3),
        is_on=lambda config: config.loss.unseen_mask,
        on=dict(loss__unseen_mask=True),
        off=dict(loss__unseen_mask=False),
        macros=("UNSEEN_MASK",), parameters=("seen",), buffers=("seen0", "seen1"),
        cases={"unseen mask": dict(loss__unseen_mask=True)}),
    "exposure": Effect(
        below=dict(exposure_change=0.0), above=dict(exposure_change=0.1),
        is_on=lambda config: config.loss.exposure,
        on=dict(loss__exposure=True),
        off=dict(loss__exposure=False),
        macros=("EXPOSURE",), parameters=("exposure",), buffers=("exposure", "matches"),
        cases={"exposure": dict(loss__exposure=True), "exposure grey": dict(loss__exposure=True, loss__grey=True)}),
    "view_dependence": Effect(
        below=dict(specularity=0.0), above=dict(specularity=0.2),
        is_on=lambda config: config.loss.structure,
        on=dict(loss__structure=True, loss__robust=0.5),
        off=dict(loss__structure=False, loss__robust=0.0),
        macros=("STRUCTURE", "ROBUST"), parameters=("robust",),
        cases={"structure": dict(loss__structure=True, loss__ssim=1.0)}),
    "shading": Effect(
        below=dict(uneven=0.0), above=dict(uneven=0.1, specularity=0.03),
        is_on=lambda config: config.loss.shading),
    "antialiasing": Effect(
        below=dict(smallest=0.5), above=dict(smallest=0.2),
        is_on=lambda config: config.splatting.low_pass > 0,
        on=dict(splatting__low_pass=0.06),
        off=dict(splatting__low_pass=0.0),
        macros=("LOW_PASS",), parameters=("low_pass",),
        cases={"order-free low-pass": dict(splatting__low_pass=0.3, splatting__radius=1.42)}),
    "smoothness": Effect(
        below=dict(textureless=0.0), above=dict(textureless=0.5),
        is_on=lambda config: config.smoothness.kind != "none",
        cases={"planar": dict(smoothness__kind="planar", smoothness__weight=0.1),
               "normal": dict(smoothness__kind="normal", smoothness__weight=0.1)}),
    "noise": Effect(
        below=dict(noise=0.002), above=dict(noise=0.02),
        is_on=lambda config: config.smoothness.weight > BALANCED.smoothness.weight),
}
COMPILED = {name: effect for name, effect in EFFECTS.items() if effect.macros}      # those that macros switch
GRADIENT_CASES = {name: settings for effect in EFFECTS.values() for name, settings in effect.cases.items()}
ALL_ON = {name: value for effect in COMPILED.values() for name, value in effect.on.items()}


def all_but(effect: str) -> Config:
    """The settings with every compiled effect but one: the hardest ones to be without it in."""
    return BALANCED.with_settings(**{**ALL_ON, **EFFECTS[effect].off})
