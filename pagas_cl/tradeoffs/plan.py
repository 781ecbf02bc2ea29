"""The settings that are measured: presets first, then one change at a time, then combinations along the front."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, fields, replace

from pagas_cl.config import Config
from pagas_cl.presets import preset

GIVEN, RANDOM, OWN_ERROR = "given", "random", "own error"


@dataclass(frozen=True)
class Setting:
    """One point to measure.

    Attributes
    ----------
    name, group : str
    stages : tuple of Config
        Run one after the other, each from the depth that the one before left.
    initial : str
        "given"; "random": uniform over the range of the initial depth; "own error": the initial depth with a smooth
        error of its own, half a pixel of parallax, as a depth map has that was made view by view.
    agree : int
        Before judging keep only the depths that this many refined context views confirm; 0 keeps all.
    paper : str
        What the paper says of the same change.
    """

    name: str
    stages: tuple[Config, ...]
    group: str = ""
    initial: str = GIVEN
    agree: int = 0
    paper: str = ""

    @property
    def contexts(self) -> int:
        """Context views that it asks for."""
        return max(stage.context.number for stage in self.stages)

    @property
    def key(self) -> str:
        """The same for equal settings, whatever they are called."""
        described = json.dumps([[stage.as_dict() for stage in self.stages], self.initial, self.agree], sort_keys=True)
        return hashlib.sha256(described.encode()).hexdigest()[:16]

    def view_steps(self, contexts: int) -> float:
        """Work with `contexts` context views: full-size pixels are gone through so many times."""
        return sum(config_view_steps(stage, contexts) for stage in self.stages) * (1 + self.agree)


def distinct(settings: list[Setting], contexts: int) -> list[Setting]:
    """Without those that are the same as an earlier one where there are only `contexts` context views."""
    kept, seen = [], set()
    for setting in settings:
        stages = tuple(_within(stage, contexts) for stage in setting.stages)
        key = replace(setting, stages=stages).key
        if key not in seen:
            seen.add(key)
            kept.append(setting)
    return kept


def _within(config: Config, contexts: int) -> Config:
    number = min(config.context.number, contexts)
    each = min(config.solver.views_per_step or number, number)
    return config.with_settings(context__number=number, solver__views_per_step=each)


def config_view_steps(config: Config, contexts: int) -> float:
    """Steps times context views a step, a step of a level counted by its share of the full size."""
    contexts = min(contexts, config.context.number)
    each = min(config.solver.views_per_step or contexts, contexts)
    return sum(scale**2 * steps * each for scale, steps in zip(config.pyramid.scales, config.pyramid.steps))


def changed(name: str, group: str, base: Config, paper: str = "", initial: str = GIVEN, agree: int = 0, **settings):
    """A Setting of one stage: `base` with `settings` changed."""
    return Setting(name, (base.with_settings(**settings),), group, initial, agree, paper)


def front_plan() -> list[Setting]:
    """The plan of `pagas-cl tradeoff`, most telling first, so that a short budget still gives a front."""
    base = fixed("balanced")  # so that a variant changes what it says and nothing else
    settings = [Setting(name, (preset(name),), "preset") for name in ("balanced", "fast", "accurate", "paper")]
    settings += _effects() + _steps(base) + _views(base) + _contexts(base) + _model(base)
    settings += _levels(base) + _solver(base) + _staged(base)
    return distinct(settings, 10**4)


def fixed(name: str) -> Config:
    """A preset without the measuring of effects: its settings hold as they are."""
    config = preset(name)
    return config.with_settings(**{f"effects__{f.name}": "set" for f in fields(config.effects)})


def _effects() -> list[Setting]:
    """Beside "balanced", which measures what a view calls for."""
    base = preset("balanced")
    every = [f.name for f in fields(base.effects)]
    return [Setting("effects as set", (fixed("balanced"),), "effects"),
            changed("all effects off", "effects", base, **{f"effects__{name}": "off" for name in every}),
            changed("exposure on", "effects", fixed("balanced"), effects__exposure="on"),
            changed("view-dependent colour on", "effects", fixed("balanced"), effects__view_dependence="on")]


def _steps(base) -> list[Setting]:
    quick = fixed("fast")
    grey = [changed(f"grey, {n} steps", "steps", quick, pyramid__steps=(n,), solver__rate=rate, solver__beta1=beta1)
            for n, rate, beta1 in ((6, 0.2, 0.7), (12, 0.16, 0.7), (30, 0.1, 0.7), (50, 0.07, 0.9), (100, 0.045, 0.9))]
    color = [changed(f"{n} steps", "steps", base, pyramid__steps=(n,), solver__rate=rate)
             for n, rate in ((20, 0.1), (35, 0.08), (50, 0.07), (75, 0.06), (100, 0.045), (200, 0.03), (400, 0.02),
                              (1000, 0.006))]
    return color[1:4] + grey[2:] + color[4:] + color[:1] + grey[:2]


def _views(base) -> list[Setting]:
    return [changed(f"{k or 'all'} views a step, {n} steps", "views a step", base, solver__views_per_step=k,
                    pyramid__steps=(n,), solver__rate=0.02 if n > 200 else base.solver.rate)
            for k, n in ((2, 90), (2, 180), (3, 60), (3, 180), (5, 400), (0, 60), (0, 180))]


def _contexts(base) -> list[Setting]:
    return [changed(f"{n} context view{'s' * (n > 1)}", "context views", base, context__number=n)
            for n in (1, 2, 3, 5, 7, 15)]


def _model(base) -> list[Setting]:
    changes = {
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
        "smoothness 0.09": dict(smoothness__weight=0.09),
    }
    return [changed(name, "model", base, **settings) for name, settings in changes.items()]


def _levels(base) -> list[Setting]:
    levels = (("half size only, 30 steps", (0.5, 1), (30, 0)), ("half size only, 100 steps", (0.5, 1), (100, 0)),
              ("half and full size, 20 + 50", (0.5, 1), (20, 50)),
              ("half and full size, 30 + 100", (0.5, 1), (30, 100)),
              ("three levels, 20 + 20 + 50", (0.25, 0.5, 1), (20, 20, 50)))
    return [changed(name, "levels", base, pyramid__scales=scales, pyramid__steps=steps)
            for name, scales, steps in levels]


def _solver(base) -> list[Setting]:
    unfiltered = dict(solver__gradient_filter=0, solver__beta2=0.999)
    return [changed("each pixel its own gradient", "solver", base, solver__gradient_filter=0),
            changed("gradient filtered over 1 pixel", "solver", base, solver__gradient_filter=1),
            changed("gradient filtered over 3 pixels", "solver", base, solver__gradient_filter=3),
            changed("long memory (beta2 0.999)", "solver", base, solver__beta2=0.999),
            changed("both, 200 steps", "solver", base, **unfiltered, pyramid__steps=(200,), solver__rate=0.04),
            changed("half the rate", "solver", base, solver__rate=0.5 * base.solver.rate),
            changed("twice the rate", "solver", base, solver__rate=2 * base.solver.rate),
            changed("rate kept to the end", "solver", base, solver__final_rate=1.0),
            changed("early stop on the loss", "solver", base, solver__patience=20, pyramid__steps=(200,))]


def _staged(base) -> list[Setting]:
    """Time spent where it pays: few views or grey photos while the depth is still rough, the rest at the end."""
    few = base.with_settings(context__number=3, pyramid__scales=(0.5, 1), pyramid__steps=(30, 0))
    grey = base.with_settings(loss__grey=True, solver__rate=0.07, solver__final_rate=1.0, pyramid__steps=(20,))
    rest = base.with_settings(pyramid__steps=(50,))
    late = base.with_settings(solver__views_per_step=3, pyramid__steps=(15,), solver__rate=0.02)
    start = base.with_settings(pyramid__steps=(50,), solver__rate=0.07, solver__final_rate=1.0)
    return [Setting("half size with 3 views, then 50 full steps", (few, rest), "staged"),
            Setting("20 grey steps, then 50 in colour", (grey, rest), "staged"),
            Setting("50 steps, then 15 with 3 views each", (start, late), "staged")]
