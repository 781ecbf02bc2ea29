"""What a run may take: the best settings for `--time-per-view` and `--time-budget`, and how much host memory it will
need, logged before it begins. Where the device is a CPU its memory is the host's."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from pagas_cl.config import Config, Fusion
from pagas_cl.errors import InputError, log
from pagas_cl.method.splat.budget import plan_for
from pagas_cl.method.surface.blocks import USUAL_MB, cut
from pagas_cl.method.surface.fuse import plan_with_blocks
from pagas_cl.method.surface.keep_mesh import mesh_mb
from pagas_cl.progress import Progress, stage
from pagas_cl.runtime.host import resident_mb, trim
from pagas_cl.scene.choice import MOST_HELD_OUT
from pagas_cl.scene.view import View

_KERNELS = 60.0          # MB: compiled, and what their compiler keeps
_VIEW = 85               # bytes a pixel of the view under way: photos read ahead, results, what judges and draws them
_AGREE = 64              # the same of a comparison with others, on the device, and 8 of each other view
_GRID = 430              # bytes a pixel of a grid, where views overlap as little as they can


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


def log_memory(views: Sequence[View], config: Config, device, fused: bool,
                memory_mb: float | None, solved: bool = False) -> dict[str, float]:
    """Log the most MB that refining these views, and fusing them or solving the mesh (in `memory_mb`), will take, with
    what this process has now; gives them by stage."""
    trim()
    now, cameras = resident_mb(), [view.camera for view in views]
    largest = max(camera.width * camera.height for camera in cameras)
    contexts = min(config.context.number, len(views) - 1)
    on_device = 0.0
    if contexts and getattr(getattr(device, "info", None), "kind", "GPU") == "CPU":
        some = sorted(cameras, key=lambda camera: -camera.width * camera.height)[:1 + contexts + MOST_HELD_OUT]
        plan = plan_for(some, contexts, config)
        agree = largest * (_AGREE + 8 * (1 + contexts)) + plan.photos
        on_device = min(max(plan.nbytes, agree), device.memory.limit) / 1e6
    planned = {"refining": now + on_device + _KERNELS + largest * _VIEW / 1e6}
    if fused:
        whole = sum(camera.width * camera.height for camera in cameras) * _GRID / 1e6
        planned["fusing"] = now + _KERNELS + min(whole, memory_mb or USUAL_MB)
    if solved:
        planned["the mesh"] = now + _KERNELS + (memory_mb or mesh_mb(cameras))
    log.debug("host memory: %s MB are planned (%s)", f"{max(planned.values()):,.0f}",
              ", ".join(f"{stage} {mb:,.0f}" for stage, mb in planned.items()))
    return planned
