"""Every setting of the tables in docs/benchmarks.md: the plan of `pagas-cl tradeoff` with one change of "balanced" at a
time and combinations, and the paper's ablation.

The paper's figures in the ablation are of DTU scan 24 (Chamfer distance, mm, its full method 0.456 to 0.458) as far as
they are known here; the other rows of its table have none.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from zlib import crc32

import numpy as np

from pagas_cl.app.tradeoffs.case import BenchmarkCase, Outcome, Setting, distinct, fixed, front_plan, key_of
from pagas_cl.app.tradeoffs.costs import Cost
from pagas_cl.config import Config, Effects
from pagas_cl.config.presets import preset
from pagas_cl.method.surface.agree import counts
from pagas_cl.scene.depthmap import depth_up, surface_depth

FULL = "0.456-0.458"


@dataclass(frozen=True)
class Staged(Setting):
    """`config`, then `later`: each from the depth that the one before left."""

    later: tuple[Config, ...] = ()

    @property
    def stages(self) -> list[Setting]:
        return [Setting(self.name, config) for config in (self.config, *self.later)]

    @property
    def contexts(self) -> int:
        return max(stage.config.context.number for stage in self.stages)

    @property
    def key(self) -> str:
        return key_of([stage.config.as_dict() for stage in self.stages])

    def limited(self, contexts: int) -> Staged:
        return self._with([stage.limited(contexts) for stage in self.stages])

    def shortened(self) -> Staged:
        return self._with([stage.shortened() for stage in self.stages])

    def outcome(self, case: BenchmarkCase, device, photos) -> Outcome:
        depth, work, most = surface_depth(case.initial), 0.0, 0
        for stage in self.stages:
            found = stage.refined(case.target, case.contexts, depth, device, photos)
            depth = found.depth
            work += found.view_steps
            most = max(most, found.device_bytes)
        return Outcome(depth, work, most)

    def seconds(self, cost: Cost, case: BenchmarkCase) -> float:
        return sum(stage.seconds(cost, case) for stage in self.stages)

    def _with(self, stages: list[Setting]) -> Staged:
        first, *later = [stage.config for stage in stages]
        return replace(self, config=first, later=tuple(later))


def given_depth(case: BenchmarkCase) -> np.ndarray:
    """The initial depth as it is."""
    return surface_depth(case.initial)


def own_error(case: BenchmarkCase) -> np.ndarray:
    """The initial depth with a smooth error of its own, half a pixel of parallax, as a depth map has that was made view
    by view; the same every time."""
    given = given_depth(case)
    moved = np.maximum(given + 0.5 * case.parallax * _smooth_noise(_rng_of(case), given.shape, 40), 0)
    return np.where(given > 0, moved, 0).astype(np.float32)


def random_depth(case: BenchmarkCase) -> np.ndarray:
    """Uniform over the range of the initial depth, the same every time."""
    given = given_depth(case)
    surface = given > 0
    drawn = _rng_of(case).uniform(float(given[surface].min()), float(given[surface].max()), given.shape)
    return np.where(surface, drawn, 0).astype(np.float32)


def _rng_of(case: BenchmarkCase):
    return np.random.default_rng(crc32(case.name.encode("utf-8", "surrogatepass")))


def _smooth_noise(rng, shape, wavelength: int) -> np.ndarray:
    """Noise of mean absolute value 1 that changes over `wavelength` pixels, float64 (H, W)."""
    coarse = rng.uniform(1.0, 3.0, [max(2, n // wavelength + 2) for n in shape]).astype(np.float32)
    noise = depth_up(coarse, shape[1], shape[0]).astype(np.float64) - 2.0
    return noise / np.abs(noise).mean()


@dataclass(frozen=True)
class AblationRow(Setting):
    """A row of the paper's ablation: what the paper says of it, and what is not a matter of `config`.

    `start` makes the depth that it starts from; with `agree` above 0 only depths are kept that so many refined context
    views confirm, whose initial depths (H, W), or None, are in `depths` by the case's name.
    """

    paper: str = ""
    start: Callable[[BenchmarkCase], np.ndarray] = given_depth
    agree: int = 0
    depths: dict[str, list] = field(default_factory=dict, repr=False, compare=False)

    @property
    def key(self) -> str:
        return key_of([self.config.as_dict(), self.start.__name__, self.agree])

    def shortened(self) -> AblationRow:
        return replace(super().shortened(), agree=0)

    def outcome(self, case: BenchmarkCase, device, photos) -> Outcome:
        found = self.refined(case.target, case.contexts, self.start(case), device, photos)
        if not self.agree:
            return found
        return replace(found, depth=self._confirmed(case, found.depth, device, photos),
                       view_steps=found.view_steps * (1 + self.agree))

    def seconds(self, cost: Cost, case: BenchmarkCase) -> float:
        return (1 + 2 * self.agree) * super().seconds(cost, case)

    def _confirmed(self, case: BenchmarkCase, depth: np.ndarray, device, photos) -> np.ndarray:
        """The depth where enough refined context views confirm it, 0 at other pixels."""
        views = [case.target, *case.contexts]
        there = [(view, start) for view, start in zip(case.contexts, self.depths[case.name]) if start is not None]
        cameras, others = [], []
        for view, start in there[:2 * self.agree]:
            around = [other for other in views if other is not view]
            cameras.append(view.camera)
            others.append(self.refined(view, around, start, device, photos).depth)
        count, _ = counts(case.target.camera, depth, cameras, others, self.config.fusion.agree_pixels, device)
        return np.where(count >= self.agree, depth, np.float32(0))


def every_setting() -> list[Setting]:
    """All that the table of settings has."""
    base = fixed("balanced")  # so that a variant changes what it says and nothing else
    effects = [Setting("effects as set", base, "effects"),  # next to "balanced", which measures what is needed
               Setting("all effects off", replace(preset("balanced"), effects=Effects.every("off")), "effects"),
               Setting("exposure on", base.with_settings(effects__exposure="on"), "effects"),
               Setting("view-dependent colour on", base.with_settings(effects__view_dependence="on"), "effects")]
    variants = [Setting(name, base.with_settings(**changes), group)
                for group, named in _variants(base.solver.rate).items() for name, changes in named.items()]
    return distinct([*front_plan(), *effects, *variants, *_staged(base)], 10**4)


def _variants(rate: float) -> dict[str, dict[str, dict]]:
    """Group -> name -> what is changed of a base with this learning rate."""
    return {
        "views a step": {
            f"{k or 'all'} views a step, {n} steps": dict(
                solver__views_per_step=k, pyramid__steps=(n,), solver__rate=0.02 if n > 200 else rate)
            for k, n in ((2, 90), (2, 180), (3, 60), (3, 180), (5, 400), (0, 60), (0, 180))},
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
    return [Staged("half size with 3 views, then 50 full steps", few, "staged", (rest,)),
            Staged("20 grey steps, then 50 in colour", grey, "staged", (rest,)),
            Staged("50 steps, then 15 with 3 views each", start, "staged", (late,))]


def ablation_plan(base_name: str = "paper", depths: dict[str, list] | None = None) -> list[AblationRow]:
    """Every row of the paper's ablation for the preset `base_name`, the base itself first: each is one change of it.

    `depths`: initial depths of the context views by the case's name, for the row of stereo consistency.
    """
    base = fixed(base_name)
    steps, by_distance = base.pyramid.steps[-1], base.solver.rate_unit == "distance"
    rows = [AblationRow(base_name, base, "ablation", FULL if base_name == "paper" else "")]

    def add(name, paper="-", start=given_depth, agree=0, **settings):
        rows.append(AblationRow(f"{base_name}: {name}", base.with_settings(**settings), "ablation", paper, start, agree,
                                depths or {}))

    add("initial depth per view", start=own_error)
    add("random initial depth", "worse", start=random_depth)
    for number in (1, 2, 3, 5, 7, 9):
        add(f"{number} context view{'s' * (number > 1)}", "0.465 (worse), 4x faster, 2 GB for 8" if number == 1 else
            "between 1 view and 10", context__number=number)
    if len(base.pyramid.scales) > 1:
        add("one level", "0.460 (worse)", pyramid__scales=(1.0,), pyramid__steps=(steps,))
    else:
        add("half size first", f"{FULL} for 0.460", **_levels((steps, steps)))
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
