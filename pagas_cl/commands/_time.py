"""Settings for a given time: `--time-per-view`, `--time-budget`."""

from __future__ import annotations

import logging

from pagas_cl.config import Config
from pagas_cl.errors import InputError

log = logging.getLogger("pagas_cl")


def check_times(per_view: float | None, budget: float | None, preset: str, several: bool) -> None:
    """Refuse what contradicts itself; `several`: the work is done on several devices."""
    if per_view is not None and budget is not None:
        raise InputError("expected --time-per-view or --time-budget, got both")
    if several and (per_view is not None or budget is not None):
        raise InputError("--time-per-view and --time-budget measure one device: leave out --devices and --scheduler, "
                         "or choose the settings with --preset")
    given = {"--time-per-view": per_view, "--time-budget": budget}
    for name, value in given.items():
        if value is not None and not value > 0:
            raise InputError(f"{name} is {value:g}, expected more than 0")
        if value is not None and preset != "balanced":
            raise InputError(f"{name} chooses the settings itself: leave out --preset {preset} (--set and --context "
                             "hold)")


def config_in_time(views, depths, names, device, per_view: float | None, budget: float | None, change) -> Config:
    """The best settings whose expected time fits, told in the log; `change(config)` is applied to all of them first.

    Parameters
    ----------
    views, depths, names, device
        As in refine_views.
    per_view, budget : float or None
        Seconds a view, or minutes for all of them; one of the two.
    """
    from pagas_cl.costs import Costs

    costs = Costs(views, depths, device, names)
    choice = costs.choose(per_view if per_view is not None else 60 * budget / len(costs.pixels), change)
    log.info("settings: %s, about %.3g s per view, %.1f minutes for %d views (reading the mesh and fusing not counted)",
             choice.name, choice.seconds, choice.seconds * choice.views / 60, choice.views)
    return choice.config
