"""What a setting may hold: the rules that the fields of a stage are declared by, and the check of them."""

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import Any

from pagas_cl.errors import InputError, short


def setting(default: Any, rule: Callable[[Any, Any], tuple[bool, str]], define: str = "") -> Any:
    """A field of a stage. `rule(value, stage)`: does it hold, what is expected; `define`: a switch's in kernels."""
    return field(default=default, metadata={"rule": rule, "define": define})


def one_of(default: str, *choices: str) -> Any:
    return setting(default, lambda value, _: (value in choices, " or ".join(map(repr, choices))))


def real(default: float, low: float | str, high: float | str) -> Any:
    """From `low` to `high`; a str names another setting of the stage, one before it."""
    def rule(value: Any, stage: Any) -> tuple[bool, str]:
        least, most = (getattr(stage, end) if isinstance(end, str) else end for end in (low, high))
        ok = isinstance(value, (int, float)) and not isinstance(value, bool) and least <= value <= most
        return ok, f"a number from {least:g} to {most:g}"

    return setting(default, rule)


def is_whole(value: Any, low: int, high: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and low <= value <= high


def whole(default: int, low: int, high: int) -> Any:
    return setting(default, lambda value, _: (is_whole(value, low, high), f"a whole number from {low} to {high}"))


def switch(default: bool, define: str = "") -> Any:
    """On or off; `define` as in `setting`."""
    return setting(default, lambda value, _: (isinstance(value, bool), "true or false"), define)


def effect() -> Any:
    return one_of("auto", "auto", "on", "off", "set")


def _plain(value: Any) -> Any:
    """NumPy's numbers, which JSON does not take, as Python's, in a tuple, too."""
    if isinstance(value, tuple):
        return tuple(_plain(item) for item in value)
    return value.item() if getattr(value, "ndim", None) == 0 else value


@dataclass(frozen=True)
class Stage:
    """Settings that are checked when they are made."""

    def __post_init__(self) -> None:
        for own in fields(self):
            value = _plain(getattr(self, own.name))
            object.__setattr__(self, own.name, value)
            holds, expected = own.metadata["rule"](value, self)
            if not holds:
                raise InputError(f"setting {type(self).__name__.lower()}.{own.name} is {short(value)}, expected "
                                 f"{expected}")
