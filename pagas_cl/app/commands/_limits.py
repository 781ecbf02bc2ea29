"""What a run may take: the best settings for `--time-per-view` and `--time-budget`, and host memory to fuse in."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from pagas_cl.config import Config, Fusion
from pagas_cl.errors import InputError, log
from pagas_cl.method.surface.blocks import cut
from pagas_cl.method.surface.fuse import plan_with_blocks
from pagas_cl.progress import Progress, stage
from pagas_cl.scene.view import View


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


@dataclass(frozen=True)
class TimeLimits:
    """The time that refining may take: seconds `per_view`, or minutes for all views (`budget`), or neither; `change(
    config)` is applied to all settings that are tried."""

    per_view: float | None
    budget: float | None
    change: Callable[..., Config]

    def config(self, views, depths, names, device, config: Config, progress: Progress) -> Config:
        """`config` where there is no limit, else the best settings whose expected time fits, which are logged.

        Arguments as in refine_views; whether cameras are refined is decided already, in `config`.
        """
        if self.per_view is None and self.budget is None:
            return config
        from pagas_cl.app.tradeoffs.costs import RUNS, Costs

        change = partial(self.change, effects__cameras=config.effects.cameras)
        with stage(progress, "time the settings", RUNS) as timing:
            costs = Costs(views, depths, device, names, timing)
            seconds = self.per_view if self.per_view is not None else 60 * self.budget / len(costs.pixels)
            choice = costs.choose(seconds, change)
            timing.advance(RUNS)
        log.info("settings: %s, about %.3g s per view, %.1f minutes for %d views (reading the mesh and fusing not "
                 "counted)", choice.name, choice.seconds, choice.seconds * choice.views / 60, choice.views)
        return choice.config


def check_fusion(views: Sequence[View], depths: Sequence, settings: Fusion, memory_mb: float) -> None:
    """Before views are refined: InputError where their `depths`, as they are now, cannot be fused in `memory_mb`."""
    plan, blocks = plan_with_blocks(views, depths, settings, [])
    if plan.memory_mb > memory_mb:
        cut(plan, blocks, memory_mb, views)
