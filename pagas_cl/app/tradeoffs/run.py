"""The settings that `pagas-cl tradeoff` measures, and one of them on one case: the refined depth, its time and its
memory; and how long that will take."""

import hashlib
import json
import time
from dataclasses import dataclass, replace

import numpy as np

from pagas_cl.app.tradeoffs.case import BenchmarkCase
from pagas_cl.app.tradeoffs.costs import Cost, probe, view_steps, views_of_step
from pagas_cl.config import Config, Effects
from pagas_cl.config.presets import preset
from pagas_cl.method.view.one_view import refine_depth
from pagas_cl.scene.depthmap import surface_depth


@dataclass(frozen=True, eq=False)
class Outcome:
    """What one run gives."""

    depth: np.ndarray    # (H, W), float32
    view_steps: float    # full-size steps of the setting times its context views
    device_bytes: int    # most that was taken, photos included


@dataclass(frozen=True)
class Setting:
    """One point to measure."""

    name: str
    config: Config
    group: str = ""

    @property
    def contexts(self) -> int:
        """Most context views that it takes."""
        return self.config.context.number

    @property
    def key(self) -> str:
        """The same for equal settings, whatever they are called."""
        return key_of(self.config.as_dict())

    def limited(self, contexts: int) -> "Setting":
        """What it is where there are only `contexts` context views."""
        each = views_of_step(self.config, contexts)
        return self.changed(context__number=min(self.contexts, contexts), solver__views_per_step=each)

    def shortened(self) -> "Setting":
        """The same with at most a step a level, which compiles and uploads all that it needs."""
        return self.changed(pyramid__steps=tuple(min(1, n) for n in self.config.pyramid.steps))

    def changed(self, **settings) -> "Setting":
        """The same with other settings, named as in Config.with_settings."""
        return replace(self, config=self.config.with_settings(**settings))

    def outcome(self, case: BenchmarkCase, device, photos) -> Outcome:
        """Refine the target of `case` with its first context views."""
        return self.refined(case.target, case.contexts, surface_depth(case.initial), device, photos)

    def refined(self, target, contexts, depth, device, photos) -> Outcome:
        """Refine `depth` of `target` with the first of `contexts`, the effects measured: what a user gets of this view
        by itself."""
        contexts = contexts[:self.contexts]
        found = refine_depth(target, contexts, depth, config=self.config, device=device, photos=photos)
        return Outcome(found.depth, view_steps(self.config, len(contexts)), found.report["device_bytes"])

    def seconds(self, cost: Cost, case: BenchmarkCase) -> float:
        """How long that will take by `cost`, that of the preset "balanced", whose kernels do other work."""
        config, contexts = self.config, len(case.contexts)
        factor = (1 + 2 * round(config.splatting.radius))**2 / 9 * (4.0 if config.splatting.blend == "alpha" else 1.0)
        factor *= 0.7 if config.loss.grey else 1.0
        cost = replace(cost, step=cost.step * views_of_step(config, contexts))
        return factor * cost.seconds(config, case.pixels, contexts)


def key_of(described) -> str:
    """A short text that differs where what `described` (for JSON) says differs."""
    return hashlib.sha256(json.dumps(described, sort_keys=True).encode()).hexdigest()[:16]


def fixed(name: str) -> Config:
    """A preset without the measuring of effects: its settings hold as they are."""
    return replace(preset(name), effects=Effects.every("set"))


def distinct(settings: list[Setting], contexts: int) -> list[Setting]:
    """Without those that are the same as an earlier one where there are only `contexts` context views."""
    first: dict[str, Setting] = {}
    for setting in settings:
        first.setdefault(setting.limited(contexts).key, setting)
    return list(first.values())


def front_plan() -> list[Setting]:
    """The plan of `pagas-cl tradeoff`, most informative first, so that a short budget still gives a front."""
    presets = [Setting(name, preset(name), "preset") for name in ("balanced", "fast", "accurate", "paper")]
    return distinct(presets + step_variants() + context_variants(), 10**4)


def step_variants() -> list[Setting]:
    """Presets with other numbers of steps, each with the rate that suits it: in colour, and grey ("fast")."""
    color, grey = fixed("balanced"), fixed("fast")
    return [Setting(f"{'grey, ' * (base is grey)}{n} steps", base.with_settings(
                        pyramid__steps=(n,), solver__rate=rate, solver__beta1=beta1), "steps")
            for base, n, rate, beta1 in (
                (color, 35, 0.08, 0.9), (color, 50, 0.07, 0.9), (color, 75, 0.06, 0.9),
                (grey, 30, 0.1, 0.7), (grey, 50, 0.07, 0.9), (grey, 100, 0.045, 0.9),
                (color, 100, 0.045, 0.9), (color, 200, 0.03, 0.9), (color, 400, 0.02, 0.9), (color, 1000, 0.006, 0.9),
                (color, 20, 0.1, 0.9), (grey, 6, 0.2, 0.7), (grey, 12, 0.16, 0.7))]


def context_variants() -> list[Setting]:
    """The preset "balanced" with other numbers of context views."""
    base = fixed("balanced")
    return [Setting(f"{n} context view{'s' * (n > 1)}", base.with_settings(context__number=n), "context views")
            for n in (1, 2, 3, 5, 7, 15)]


def run(setting: Setting, case: BenchmarkCase, device, photos, repeats: int = 1) -> tuple[Outcome, float]:
    """Run `setting` on `case`, after a run of a step a level that compiles and uploads.

    The seconds, the median of the repeats, are from photos on the device to the depth on the host, the measuring of
    effects included, compiling not.
    """
    setting.shortened().outcome(case, device, photos)
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        outcome = setting.outcome(case, device, photos)
        times.append(time.perf_counter() - start)
    return outcome, float(np.median(times))


class Guess:
    """How long a run and its judging will take: by its work, corrected by how long the ones before it took."""

    def __init__(self, case: BenchmarkCase, device, repeats: int):
        self.cost = probe(case.target, case.contexts, case.initial, preset("balanced"), device)
        self.repeats, self.factor = repeats, 1.3

    def seconds(self, setting: Setting, case: BenchmarkCase) -> float:
        judging = 1e-6 * case.pixels * (1 + len(case.held_out))
        return self.factor * (setting.seconds(self.cost, case) * self.repeats + judging + 0.5)

    def learn(self, setting: Setting, case: BenchmarkCase, seconds: float) -> None:
        ratio = self.factor * seconds / self.seconds(setting, case)
        self.factor = 0.8 * self.factor + 0.2 * min(10.0, max(0.1, ratio))
