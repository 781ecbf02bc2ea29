"""How much host memory a run will take, logged before it begins. Where the device is a CPU its memory is the host's."""

from collections.abc import Sequence

from pagas_cl.config import Config, Fusion
from pagas_cl.errors import log
from pagas_cl.method.splat.budget import plan_for
from pagas_cl.method.surface.blocks import USUAL_MB, cut
from pagas_cl.method.surface.fuse import plan_with_blocks
from pagas_cl.method.surface.keep_mesh import mesh_mb
from pagas_cl.runtime.host import resident_mb, trim
from pagas_cl.scene.choice import MOST_HELD_OUT
from pagas_cl.scene.view import View

_KERNELS = 60.0          # MB: compiled, and what their compiler keeps
_VIEW = 85               # bytes a pixel of the view under way: photos read ahead, results, what judges and draws them
_AGREE = 64              # the same of a comparison with others, on the device, and 8 of each other view
_GRID = 430              # bytes a pixel of a grid, where views overlap as little as they can


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
