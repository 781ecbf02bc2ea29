"""The settings that `pagas-cl tradeoff` measures: the presets, fewer and more steps, fewer and more context views."""

from dataclasses import replace

from pagas_cl.app.tradeoffs.run import Setting
from pagas_cl.config import Config, Effects
from pagas_cl.config.presets import preset


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

    def colored(*steps_and_rates) -> list[Setting]:
        return [Setting(f"{n} steps", color.with_settings(pyramid__steps=(n,), solver__rate=rate), "steps")
                for n, rate in steps_and_rates]

    def greyed(*steps_rates_and_betas) -> list[Setting]:
        return [Setting(f"grey, {n} steps",
                        grey.with_settings(pyramid__steps=(n,), solver__rate=rate, solver__beta1=beta1), "steps")
                for n, rate, beta1 in steps_rates_and_betas]

    return [*colored((35, 0.08), (50, 0.07), (75, 0.06)), *greyed((30, 0.1, 0.7), (50, 0.07, 0.9), (100, 0.045, 0.9)),
            *colored((100, 0.045), (200, 0.03), (400, 0.02), (1000, 0.006), (20, 0.1)),
            *greyed((6, 0.2, 0.7), (12, 0.16, 0.7))]


def context_variants() -> list[Setting]:
    """The preset "balanced" with other numbers of context views."""
    base = fixed("balanced")
    return [Setting(f"{n} context view{'s' * (n > 1)}", base.with_settings(context__number=n), "context views")
            for n in (1, 2, 3, 5, 7, 15)]
