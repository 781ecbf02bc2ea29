"""A mesh fused from refined depth maps, where the work is done: in this process, or boxes of the grid by others."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from pagas_cl.config import Config
from pagas_cl.errors import log
from pagas_cl.jobs.finished import StoredResult
from pagas_cl.jobs.place import Place
from pagas_cl.method.effects.decide import decide_consistency
from pagas_cl.method.surface import blocks
from pagas_cl.method.surface.agree import comparison_device, confirmed
from pagas_cl.method.surface.fuse import weights_of
from pagas_cl.method.surface.keep_mesh import polished
from pagas_cl.method.surface.mesh_options import NO_MESH, MeshOptions
from pagas_cl.progress import Reporter, progress_of
from pagas_cl.result import DepthResult
from pagas_cl.scene.mesh import Surface
from pagas_cl.scene.view import View, joined


def fuse_results(views: Sequence[View], results: Sequence[DepthResult], config: Config, progress: Reporter = None,
                 making: MeshOptions = NO_MESH, place: Place = Place()) -> Surface:
    """Keep what other views confirm, then TSDF: a Surface, in `making.memory_mb` of host memory, or what is free.
    Results find their views by name; views without one take no part. `making.note(text)` is a callback with whether
    other views were compared. Boxes of a grid that does not fit go to the executor of `place` where files are all it
    needs. Views are compared on its device, or in NumPy."""
    device, pairs = comparison_device(place.device), sorted(joined(views, results), key=lambda pair: pair[0])
    used = [views[k] if result.camera is views[k].camera else replace(views[k], camera=result.camera)
            for k, result in pairs]      # a result's camera may have been refined with it
    results = [result for _, result in pairs]
    cameras = [view.camera for view in used]
    config, decision = decide_consistency(cameras, results, config, device)
    if decision is not None:
        log.debug("%s", decision)
        if making.note:
            making.note(str(decision))
    on_disk = config.fusion.agree_views == 0  # read one at a time, then
    depths = [result.file if on_disk and isinstance(result, StoredResult) else result.depth for result in results]
    agreed = confirmed(cameras, depths, config.fusion, device=device)
    files = all(isinstance(source, Path) for source in (*agreed, *(view.image for view in used)))
    boxes_by = place.executor if files and hasattr(place.executor, "map") else None      # not where it is an address
    fused = blocks.fuse_within(used, agreed, config.fusion, making.memory_mb, progress=progress_of(progress),
                               executor=boxes_by, folder=place.folder,
                               weights=weights_of(results, config.fusion.least_weight))
    return polished(fused, results, config, device) if config.fusion.polish and device is not None else fused
