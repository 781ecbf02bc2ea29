"""Settings as text: `stage.field=value` of `--set`, `exposure=off` of `--effect`."""

import math

from pagas_cl.config import Config, setting_names
from pagas_cl.config.presets import preset
from pagas_cl.errors import InputError

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
