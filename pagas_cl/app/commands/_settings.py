"""The best settings for `--time-per-view` and `--time-budget`."""

from pagas_cl.config import Config
from pagas_cl.errors import InputError, log
from pagas_cl.progress import Progress, stage


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
    """The best settings whose expected time fits, which is logged; `change(config)` is applied to all of them first.

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
