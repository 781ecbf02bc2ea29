"""The settings that are measured: the front's plan (presets, one change at a time, combinations), the paper's ablation.

The paper's figures in the ablation are of DTU scan 24 (Chamfer distance, mm, its full method 0.456 to 0.458) as far as
they are known here; the other rows of its table have none.
"""

import hashlib
import json
from dataclasses import dataclass, replace

from pagas_cl.config import Config, Effects
from pagas_cl.config.presets import preset

GIVEN, RANDOM, OWN_ERROR = "given", "random", "own error"
_FULL = "0.456-0.458"


@dataclass(frozen=True)
class Setting:
    """One point to measure: `stages` run one after the other, each from the depth that the one before left.

    `initial`: "given"; "random": uniform over the range of the initial depth; "own error": the initial depth with a
    smooth error of its own, half a pixel of parallax, as a depth map has that was made view by view.
    """

    name: str
    stages: tuple[Config, ...]
    group: str = ""
    initial: str = GIVEN
    agree: int = 0     # keep only the depths that so many refined context views confirm; 0 keeps all
    paper: str = ""    # what the paper says of the same change

    @property
    def contexts(self) -> int:
        return max(stage.context.number for stage in self.stages)

    @property
    def key(self) -> str:
        """The same for equal settings, whatever they are called."""
        described = json.dumps([[stage.as_dict() for stage in self.stages], self.initial, self.agree], sort_keys=True)
        return hashlib.sha256(described.encode()).hexdigest()[:16]


def changed(name: str, group: str, base: Config, paper: str = "", initial: str = GIVEN, agree: int = 0, **settings):
    """A Setting of one stage: `base` with `settings` changed."""
    return Setting(name, (base.with_settings(**settings),), group, initial, agree, paper)


def fixed(name: str) -> Config:
    """A preset without the measuring of effects: its settings hold as they are."""
    return replace(preset(name), effects=Effects.every("set"))


def distinct(settings: list[Setting], contexts: int) -> list[Setting]:
    """Without those that are the same as an earlier one where there are only `contexts` context views."""
    first = {}
    for setting in settings:
        stages = []
        for stage in setting.stages:
            number = min(stage.context.number, contexts)
            each = min(stage.solver.views_per_step or number, number)
            stages.append(stage.with_settings(context__number=number, solver__views_per_step=each))
        first.setdefault(replace(setting, stages=tuple(stages)).key, setting)
    return list(first.values())


def front_plan() -> list[Setting]:
    """The plan of `pagas-cl tradeoff`, most informative first, so that a short budget still gives a front."""
    base = fixed("balanced")  # so that a variant changes what it says and nothing else
    settings = [Setting(name, (preset(name),), "preset") for name in ("balanced", "fast", "accurate", "paper")]
    settings += [Setting("effects as set", (base,), "effects"),  # next to "balanced", which measures what is needed
                 Setting("all effects off", (replace(preset("balanced"), effects=Effects.every("off")),), "effects"),
                 changed("exposure on", "effects", base, effects__exposure="on"),
                 changed("view-dependent colour on", "effects", base, effects__view_dependence="on")]
    settings += _steps(base)
    for group, variants in _variants(base.solver.rate).items():
        settings += [changed(name, group, base, **variant) for name, variant in variants.items()]
    return distinct(settings + _staged(base), 10**4)


def _steps(base: Config) -> list[Setting]:
    quick = fixed("fast")

    def color(*steps_and_rates):
        return [changed(f"{n} steps", "steps", base, pyramid__steps=(n,), solver__rate=rate)
                for n, rate in steps_and_rates]

    def grey(*steps_rates_and_betas):
        return [changed(f"grey, {n} steps", "steps", quick, pyramid__steps=(n,), solver__rate=rate, solver__beta1=beta1)
                for n, rate, beta1 in steps_rates_and_betas]

    return [*color((35, 0.08), (50, 0.07), (75, 0.06)), *grey((30, 0.1, 0.7), (50, 0.07, 0.9), (100, 0.045, 0.9)),
            *color((100, 0.045), (200, 0.03), (400, 0.02), (1000, 0.006), (20, 0.1)),
            *grey((6, 0.2, 0.7), (12, 0.16, 0.7))]


def _variants(rate: float) -> dict[str, dict[str, dict]]:
    """Group -> name -> what is changed of a base with this learning rate."""
    return {
        "views a step": {
            f"{k or 'all'} views a step, {n} steps": dict(
                solver__views_per_step=k, pyramid__steps=(n,), solver__rate=0.02 if n > 200 else rate)
            for k, n in ((2, 90), (2, 180), (3, 60), (3, 180), (5, 400), (0, 60), (0, 180))},
        "context views": {_context_views(n): dict(context__number=n) for n in (1, 2, 3, 5, 7, 15)},
        "model": {
            "radius 1.0": dict(splatting__radius=1.0), "radius 1.2": dict(splatting__radius=1.2),
            "radius 2": dict(splatting__radius=2.0), "no occlusion": dict(splatting__occlusion=False),
            "low-pass 0.3": dict(splatting__low_pass=0.3), "unseen mask": dict(loss__unseen_mask=True),
            "alpha, C/A": dict(splatting__blend="alpha", splatting__normalize=True),
            "alpha": dict(splatting__blend="alpha"), "no SSIM": dict(loss__ssim=0.0), "SSIM 0.8": dict(loss__ssim=0.8),
            "weight by gradient": dict(loss__gradient_weight=True),
            "weight by coverage": dict(loss__coverage_weight=True),
            "no smoothness": dict(smoothness__kind="none", smoothness__weight=0.0),
            "half the smoothness": dict(smoothness__weight=0.06), "twice the smoothness": dict(smoothness__weight=0.24),
            "same smoothness with few views": dict(smoothness__full_views=1),
            "smoothness 0.09": dict(smoothness__weight=0.09)},
        "levels": {
            "half size only, 30 steps": _levels((30, 0)), "half size only, 100 steps": _levels((100, 0)),
            "half and full size, 20 + 50": _levels((20, 50)), "half and full size, 30 + 100": _levels((30, 100)),
            "three levels, 20 + 20 + 50": _levels((20, 20, 50))},
        "solver": {
            "each pixel its own gradient": dict(solver__gradient_filter=0),
            "gradient filtered over 1 pixel": dict(solver__gradient_filter=1),
            "gradient filtered over 3 pixels": dict(solver__gradient_filter=3),
            "long memory (beta2 0.999)": dict(solver__beta2=0.999),
            "own gradient and long memory, 200 steps": dict(
                solver__gradient_filter=0, solver__beta2=0.999, pyramid__steps=(200,), solver__rate=0.04),
            "half the rate": dict(solver__rate=0.5 * rate), "twice the rate": dict(solver__rate=2 * rate),
            "rate kept to the end": dict(solver__final_rate=1.0),
            "early stop on the loss": dict(solver__patience=20, pyramid__steps=(200,))},
    }


def _context_views(number: int) -> str:
    return f"{number} context view{'s' * (number > 1)}"


def _levels(steps: tuple[int, ...]) -> dict:
    """Steps a level, the last one at full size, each of half the size of the next."""
    return dict(pyramid__scales=(0.25, 0.5, 1)[-len(steps):], pyramid__steps=steps)


def _staged(base: Config) -> list[Setting]:
    """Time spent where it pays: few views or grey photos while the depth is still rough, the rest at the end."""
    few = base.with_settings(context__number=3, **_levels((30, 0)))
    grey = base.with_settings(loss__grey=True, solver__rate=0.07, solver__final_rate=1.0, pyramid__steps=(20,))
    rest = base.with_settings(pyramid__steps=(50,))
    late = base.with_settings(solver__views_per_step=3, pyramid__steps=(15,), solver__rate=0.02)
    start = rest.with_settings(solver__rate=0.07, solver__final_rate=1.0)
    return [Setting("half size with 3 views, then 50 full steps", (few, rest), "staged"),
            Setting("20 grey steps, then 50 in colour", (grey, rest), "staged"),
            Setting("50 steps, then 15 with 3 views each", (start, late), "staged")]


def ablation_plan(base_name: str = "paper") -> list[Setting]:
    """Every row of the paper's ablation for the preset `base_name`, the base itself first: each is one change of it."""
    base = fixed(base_name)
    steps, by_distance = base.pyramid.steps[-1], base.solver.rate_unit == "distance"
    rows = [Setting(base_name, (base,), "ablation", paper=_FULL if base_name == "paper" else "")]

    def add(name, paper="-", **settings):
        rows.append(changed(f"{base_name}: {name}", "ablation", base, paper, **settings))

    add("initial depth per view", initial=OWN_ERROR)
    add("random initial depth", "worse", initial=RANDOM)
    for number in (1, 2, 3, 5, 7, 9):
        add(_context_views(number), "0.465 (worse), 4x faster, 2 GB for 8" if number == 1 else
            "between 1 view and 10", context__number=number)
    if len(base.pyramid.scales) > 1:
        add("one level", "0.460 (worse)", pyramid__scales=(1.0,), pyramid__steps=(steps,))
    else:
        add("half size first", f"{_FULL} for 0.460", **_levels((steps, steps)))
    add("scales 4, 2, 1", "0.495 (worse)", **_levels((100, 100, 100)))
    add("steps 200, 100", **_levels((200, 100)))
    add("steps 100, 200", **_levels((100, 200)))
    add("rate 1e-4" if by_distance else "ten times the rate", "0.563 (worse)",
        solver__rate=1e-4 if by_distance else 10 * base.solver.rate)
    add("radius 3", "0.461 (worse)", splatting__radius=3.0)
    add("4 slices", splatting__depth_slices=4.0)
    add("no occlusion", "0.464 (worse)", splatting__occlusion=False)
    if base.smoothness.kind == "none":
        add("smoothness on normals", smoothness__kind="normal", smoothness__weight=0.01)
    else:
        add("no smoothness", smoothness__kind="none", smoothness__weight=0.0)
    add("SSIM 0.8", loss__ssim=0.8)
    add("exposure", effects__exposure="on")
    add("view-dependent colour (robust loss)", effects__view_dependence="on")
    add("stereo consistency of 2 views", agree=2)
    return rows
