"""The presets, and settings as text: `stage.field=value` (--set), `exposure=off` (--effect); see stages.py."""

import math
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

from pagas_cl.config import Agreement, Config, Effects, Loss, Pyramid, Smoothness, Solver, Splatting, setting_names
from pagas_cl.errors import InputError, check_kind

# What the published DTU experiments use (arXiv 2604.22129): the yardstick, not a recommendation.
PAPER = Config(
    splatting=Splatting(blend="alpha", radius=1.42, depth_slices=20.0, depth_footprints=0.0, low_pass=0.3),
    loss=Loss(ssim=0.2, huber=0.0, gradient_weight=True, coverage_weight=True, unseen_mask=True, target_view=True),
    smoothness=Smoothness(kind="none", weight=0.0, full_views=1),
    solver=Solver(rate=1e-5, rate_unit="distance", damping=1e-8, early_damping=1.0, beta2=0.999, gradient_filter=0,
                  final_rate=1.0, patience=10, views_per_step=0, max_move=1e9, tolerance=2.0, mismatch=2.0),
    pyramid=Pyramid(scales=(0.5, 1.0), steps=(100, 100), carry_over=False),
    agreement=Agreement(steps=0.08),
    effects=Effects.every("set"),
)
# The knee of the front of error against time (`pagas-cl tradeoff`; the tables are in docs/benchmarks.md): one context
# view a step, in turn, is as good per step as all of them; five times the steps gain 2 percent with ten context views,
# 7 with one. Steps x rate / damping is how far it converges, rate / damping at most 7 that rounding stays rounding.
BALANCED = Config()
# Gives up colour, most steps, two context views and the measuring of effects (photos of one exposure, a depth within a
# pixel or two of parallax), and steps between rounds of agreement: 1.1 to 2.5 times the error of "balanced" in a
# quarter of its time or less.
FAST = replace(BALANCED.with_settings(
    loss__grey=True, smoothness__discontinuity=0.5, solver__rate=0.16, solver__damping=1e-3, solver__early_damping=1.0,
    solver__beta1=0.7, solver__gradient_filter=3, solver__photos_first=0.5, solver__final_rate=0.1,
    pyramid__steps=(20,), pyramid__far_off=(0.125, 0.25), context__number=8, agreement__steps=0.08,
    agreement__rounds=1),
    effects=replace(Effects.every("set"), pyramid="auto"))
# Past the knee: five times the steps, shorter ones, and less smoothing; 1.6 to 7 percent less error.
ACCURATE = BALANCED.with_settings(smoothness__weight=0.1, smoothness__discontinuity=0.25, solver__rate=0.008,
                                  solver__damping=3e-3, solver__early_damping=1.0, solver__photos_first=0.5,
                                  pyramid__steps=(800,), agreement__steps=0.08)
_YES_NO = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}
PRESETS: dict[str, Config] = {"fast": FAST, "balanced": BALANCED, "accurate": ACCURATE, "paper": PAPER}


def preset(name: str) -> Config:
    """The preset called `name`: "fast", "balanced", "accurate" or "paper"; InputError for any other."""
    check_kind("preset", name, (str,), f"a name, one of {', '.join(PRESETS)}")
    if name not in PRESETS:
        raise InputError(f"unknown preset {name!r}, expected {' or '.join(map(repr, PRESETS))}")
    return PRESETS[name]


def settings_of(name: str | None, config: Config | None) -> Config:
    """What a caller's `preset` and `config` ask for: one of the two, the preset "balanced" where both are None."""
    if config is None:
        return preset("balanced" if name is None else name)
    check_kind("config", config, (Config,), f"pagas_cl.Config (start from pagas_cl.preset({name or 'balanced'!r}))")
    if name is not None:
        raise InputError(f"preset {name!r} and a config were given, expected one of the two: change what "
                         f"pagas_cl.preset({name!r}) returns by its with_settings, and give that as config")
    return config


def build_config(name: str, assignments: Iterable[str], what: str = "--set") -> Config:
    """The preset with `assignments` ("stage.field=value") applied."""
    return apply_settings(preset(name), assignments, what)


def apply_settings(config: Config, assignments: Iterable[str], what: str = "--set", **more: Any) -> Config:
    """`config` with `assignments` ("stage.field=value"), called `what` in messages, and `more` (stage__field=value)."""
    settings = {}
    for text in assignments:
        key, equals, value = (part.strip() for part in text.partition("="))
        if not equals:
            raise InputError(f"{what} {text!r} has no '=', expected stage.field=value such as splatting.radius=1.42")
        settings[key] = _value(config, key, value)
    return config.with_settings(**settings, **more)


def effect_settings(effects: Iterable[str], what: str = "--effect") -> list[str]:
    """`--effect exposure=off` as the setting that it is short for; messages call it `what`."""
    for text in effects:
        if "=" not in text:
            raise InputError(f"{what} {text!r} has no '=', expected NAME=auto, on, off or set, such as exposure=off")
    return [f"effects.{text.strip()}" for text in effects]


def _value(config: Config, key: str, text: str) -> Any:
    """`text` as the type of the setting `key`; an unknown key is left for Config.with_settings to name."""
    if key not in setting_names():
        return text
    stage, _, name = key.partition(".")
    now = getattr(getattr(config, stage), name)
    try:
        if isinstance(now, bool):
            return _YES_NO[text.lower()]
        if isinstance(now, tuple):
            return tuple(_number(part) for part in text.strip("()[] ").split(",") if part.strip())
        return _number(text) if isinstance(now, (int, float)) else text
    except (KeyError, ValueError) as error:
        kind = "true or false" if isinstance(now, bool) else "numbers, such as 0.5,1" if isinstance(now, tuple) \
            else "a number"
        raise InputError(f"setting {key} is {text!r}, expected {kind}") from error


def _number(text: str) -> int | float:
    try:
        return int(text)
    except ValueError:
        number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{text} is not finite")
    return number
