"""The page of `refine --report`: pictures of each view as soon as it is done, and of the mesh in the end."""

import time
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from pagas_cl.app.report import Report
from pagas_cl.config.version import __version__
from pagas_cl.method.surface.agree import comparison_device
from pagas_cl.method.surface.raster import each_depth
from pagas_cl.refine import Refined
from pagas_cl.runtime.device import Device
from pagas_cl.scene.meshes.kinds import to_surface
from pagas_cl.scene.view import joined


def report_of(folder, found, settings: str, place, command_line: str):
    """The Report to fill, or a context of None where no folder is given."""
    if folder is None:
        return nullcontext()
    where = place.executor or (place.device.info if isinstance(place.device, Device) else place.device)
    return Report(folder, "pagas-cl refine", began=time.monotonic(),
                  facts=[("scene", f"{found.source}, {len(found.views)} views")], particulars=[
                      ("command", command_line or ""), ("settings", settings), ("version", f"pagas_cl {__version__}"),
                      ("device", str(where))])


def show_mesh(page: Report, done: Refined, mesh: Path | None, device: Any) -> None:
    """Put the given and the made mesh on the page, seen from the view of which most was refined."""
    before, after = mesh and to_surface(mesh), to_surface(done.mesh)
    place, _ = max(joined(done.views, done.results), key=lambda pair: pair[1].counts["refined"])
    view = done.views[place]
    depths = before and [next(each_depth(surface, [view.camera], comparison_device(device)))
                         for surface in (before, after)]
    page.add_mesh(before, after, view=view, depths=depths)
