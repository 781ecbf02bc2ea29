"""All settings of a run, and the presets; what each setting means is said in stages.py."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from typing import Any

from pagas_cl.errors import InputError
from pagas_cl.stages import Context, Effects, Fusion, Loss, Pyramid, Smoothness, Solver, Splatting

__all__ = ["ACCURATE", "BALANCED", "FAST", "PAPER", "PRESETS", "Config", "Context", "Effects", "Fusion", "Loss",
           "Pyramid", "Smoothness", "Solver", "Splatting", "preset", "setting_names"]


@dataclass(frozen=True)
class Config:
    """All settings of a run: one of the dataclasses in stages.py a stage, equal and hashable by value."""

    splatting: Splatting = field(default_factory=Splatting)
    loss: Loss = field(default_factory=Loss)
    smoothness: Smoothness = field(default_factory=Smoothness)
    solver: Solver = field(default_factory=Solver)
    pyramid: Pyramid = field(default_factory=Pyramid)
    context: Context = field(default_factory=Context)
    fusion: Fusion = field(default_factory=Fusion)
    effects: Effects = field(default_factory=Effects)

    def __post_init__(self):
        for stage in fields(self):
            value = getattr(self, stage.name)
            if not is_dataclass(value) or type(value).__name__ != stage.type:
                raise InputError(f"setting {stage.name} is a {type(value).__name__}, expected a {stage.type}")

    def with_settings(self, **settings: Any) -> Config:
        """A copy with `stage__field=value` or `"stage.field": value` changed: `with_settings(splatting__radius=1.4)`.

        Raises
        ------
        InputError
            No such setting (the nearest one is named), or a value out of range.
        """
        by_stage: dict[str, dict[str, Any]] = {}
        for key, value in settings.items():
            key = key.replace("__", ".")
            if key not in setting_names():
                raise InputError(f"unknown setting {key!r}; {_nearest(key)}")
            stage, _, name = key.partition(".")
            by_stage.setdefault(stage, {})[name] = value
        return replace(self, **{stage: replace(getattr(self, stage), **values) for stage, values in by_stage.items()})

    def as_dict(self) -> dict:
        """Plain nested dictionary, ready for JSON."""
        return asdict(self)


def setting_names() -> list[str]:
    """Every setting as "stage.field", in order."""
    return [f"{stage.name}.{f.name}" for stage in fields(Config) for f in fields(globals()[stage.type])]


def _nearest(key: str) -> str:
    from difflib import get_close_matches

    near = get_close_matches(key, setting_names(), n=1, cutoff=0.0)
    return f"the nearest known one is {near[0]!r}"


# What the published DTU experiments use (arXiv 2604.22129): the yardstick, not a recommendation.
PAPER = Config(
    splatting=Splatting(blend="alpha", radius=1.42, depth_slices=20.0, depth_footprints=0.0, low_pass=0.3),
    loss=Loss(ssim=0.2, huber=0.0, gradient_weight=True, coverage_weight=True, unseen_mask=True, target_view=True),
    smoothness=Smoothness(kind="none", weight=0.0, full_views=1),
    solver=Solver(rate=1e-5, unit="distance", damping=1e-8, early_damping=1.0, beta2=0.999, spread=0, final_rate=1.0,
                  patience=10, views_per_step=0, max_move=1e9, tolerance=2.0, mismatch=2.0),
    pyramid=Pyramid(scales=(0.5, 1.0), steps=(100, 100)),
    effects=Effects.every("set"),
)
# The knee of the front of error against time (`pagas-cl tradeoff`; the tables are in tests/bench/FRONT.md): one context
# view a step, in turn, is as good per step as all of them; four times the steps gain 2 percent with ten context views,
# 5 with one.
BALANCED = Config()
# Gives up colour, most steps, two context views and the measuring of effects (photos of one exposure, a depth within a
# pixel or two of parallax): 1.2 to 2.5 times the error of "balanced" in a quarter of its time or less.
FAST = BALANCED.with_settings(loss__grey=True, smoothness__cut=0.5, solver__rate=0.16, solver__damping=1e-3,
                              solver__early_damping=1.0, solver__beta1=0.7, solver__spread=3, solver__final_rate=0.1,
                              pyramid__steps=(20,), context__number=8,
                              **{f"effects__{f.name}": "set" for f in fields(Effects)})
# Past the knee: four times the steps, shorter ones, and less smoothing; 1.7 to 5 percent less error.
ACCURATE = BALANCED.with_settings(smoothness__weight=0.1, smoothness__cut=0.25, solver__rate=0.008,
                                  solver__damping=3e-3, solver__early_damping=1.0, pyramid__steps=(800,))
PRESETS: dict[str, Config] = {"fast": FAST, "balanced": BALANCED, "accurate": ACCURATE, "paper": PAPER}


def preset(name: str) -> Config:
    """The preset called `name`: "fast", "balanced", "accurate" or "paper"; InputError for any other."""
    if name not in PRESETS:
        raise InputError(f"unknown preset {name!r}, expected {' or '.join(repr(p) for p in PRESETS)}")
    return PRESETS[name]
