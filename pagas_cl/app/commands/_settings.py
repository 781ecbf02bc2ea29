"""Settings of a command line: `--set stage.field=value`, or the best for `--time-per-view` and `--time-budget`."""

import math

from pagas_cl.config import Config, setting_names
from pagas_cl.config.presets import preset
from pagas_cl.errors import InputError, log
from pagas_cl.progress import Progress, stage

_YES_NO = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}


def build_config(preset_name: str, assignments, what: str = "--set", **more) -> Config:
    """The preset with `assignments` ("stage.field=value") and `more` ("stage__field"=value) applied; messages call an
    assignment `what`."""
    return apply_settings(preset(preset_name), assignments, what, **more)


def apply_settings(config: Config, assignments, what: str = "--set", **more) -> Config:
    """`config` with the same applied."""
    settings = {}
    for text in assignments:
        key, equals, value = text.partition("=")
        key = key.strip()
        if not equals:
            raise InputError(f"{what} {text!r} has no '=', expected stage.field=value such as splatting.radius=1.42")
        settings[key] = _value(config, key, value.strip())
    return config.with_settings(**settings, **more)


def effect_settings(effects, what: str = "--effect") -> list[str]:
    """`--effect exposure=off` as the setting that it is short for; messages call it `what`."""
    for text in effects:
        if "=" not in text:
            raise InputError(f"{what} {text!r} has no '=', expected NAME=auto, on, off or set, such as exposure=off")
    return [f"effects.{text.strip()}" for text in effects]


def _value(config: Config, key: str, text: str):
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


def _number(text: str):
    try:
        return int(text)
    except ValueError:
        number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{text} is not finite")
    return number


def check_times(per_view: float | None, budget: float | None, preset: str, several: bool) -> None:
    """Refuse what contradicts itself; `several`: the work is done on several devices."""
    given = {name: value for name, value in (("--time-per-view", per_view), ("--time-budget", budget))
             if value is not None}
    if len(given) > 1:
        raise InputError("expected --time-per-view or --time-budget, got both")
    if several and given:
        raise InputError("--time-per-view and --time-budget measure one device: leave out --devices and --scheduler, "
                         "or choose the settings with --preset")
    for name in given:
        if preset != "balanced":
            raise InputError(f"{name} chooses the settings itself: leave out --preset {preset} (--set and --context "
                             "hold)")


def config_in_time(views, depths, names, device, per_view: float | None, budget: float | None, change,
                   progress: Progress) -> Config:
    """The best settings whose expected time fits, told in the log; `change(config)` is applied to all of them first.

    Arguments as in refine_views; `per_view` seconds, or `budget` minutes for all views: one of the two.
    """
    from pagas_cl.app.tradeoffs.costs import RUNS, Costs

    with stage(progress, "time the settings", RUNS) as timing:
        costs = Costs(views, depths, device, names, timing)
        choice = costs.choose(per_view if per_view is not None else 60 * budget / len(costs.pixels), change)
        timing.advance(RUNS)
    log.info("settings: %s, about %.3g s per view, %.1f minutes for %d views (reading the mesh and fusing not counted)",
             choice.name, choice.seconds, choice.seconds * choice.views / 60, choice.views)
    return choice.config
