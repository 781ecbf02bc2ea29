"""All settings of a run: Config, which holds those of each stage (pagas_cl.config.stages)."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from functools import cache
from typing import Any

from pagas_cl.config.stages import (
    Agreement,
    Context,
    Effects,
    Fusion,
    Loss,
    Pyramid,
    Smoothness,
    Solver,
    Splatting,
)
from pagas_cl.errors import InputError, nearest_of

__all__ = ["Agreement", "Config", "Context", "Effects", "Fusion", "Loss", "Pyramid", "Smoothness", "Solver",
           "Splatting", "setting_names"]


@dataclass(frozen=True)
class Config:
    """All settings of a run: a dataclass of pagas_cl.config.stages for each stage; equal and hashable by value."""

    splatting: Splatting = field(default_factory=Splatting)
    loss: Loss = field(default_factory=Loss)
    smoothness: Smoothness = field(default_factory=Smoothness)
    solver: Solver = field(default_factory=Solver)
    pyramid: Pyramid = field(default_factory=Pyramid)
    context: Context = field(default_factory=Context)
    fusion: Fusion = field(default_factory=Fusion)
    agreement: Agreement = field(default_factory=Agreement)
    effects: Effects = field(default_factory=Effects)

    def __post_init__(self) -> None:
        for stage in fields(self):
            value = getattr(self, stage.name)
            if not is_dataclass(value) or type(value).__name__ != stage.type:
                raise InputError(f"setting {stage.name} is a {type(value).__name__}, expected a {stage.type}")

    def with_settings(self, **settings: Any) -> Config:
        """A copy with `stage__field=value` or `"stage.field": value` changed: `with_settings(splatting__radius=1.4)`.

        InputError: no such setting (the nearest one is named), or a value out of range.
        """
        by_stage: dict[str, dict[str, Any]] = {}
        for key, value in settings.items():
            key = key.replace("__", ".")
            if key not in setting_names():
                fields_of = [name for name in setting_names() if name.partition(".")[0] == key.rpartition(".")[0]]
                raise InputError(f"unknown setting {key!r}; " + (nearest_of(key, setting_names()) or "expected " + (
                    ", ".join(fields_of)
                    or f"stage.field, of the stages {', '.join(stage.name for stage in fields(self))}")))
            stage, _, name = key.partition(".")
            by_stage.setdefault(stage, {})[name] = value
        stages = {stage: replace(getattr(self, stage), **values) for stage, values in by_stage.items()}
        changed = replace(self, **stages)
        return self if changed == self else changed

    def as_dict(self) -> dict[str, dict[str, Any]]:
        """Plain nested dictionary, ready for JSON."""
        return asdict(self)


@cache
def setting_names() -> list[str]:
    """Every setting as "stage.field", in order."""
    default = Config()
    return [f"{stage.name}.{own.name}" for stage in fields(default) for own in fields(getattr(default, stage.name))]
