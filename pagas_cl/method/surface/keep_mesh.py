"""The given mesh, its vertices on the refined depths, all else as it was: `refine_mesh(..., output="mesh")` or
"displace"."""

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from pagas_cl.config import Config
from pagas_cl.errors import DeviceMemoryError, InputError, log, short
from pagas_cl.method.surface.agree import comparison_device
from pagas_cl.method.surface.fuse import available_mb
from pagas_cl.method.surface.mesh_evidence import Observed, sent
from pagas_cl.method.surface.mesh_faults import without_new
from pagas_cl.method.surface.mesh_levels import DETAIL, FLAT, TRIANGLE_BYTES, fit_mesh, undo_splits
from pagas_cl.method.surface.mesh_solve import ROUNDS, solve_mesh
from pagas_cl.method.surface.on_vertices import footprints, vertex_confidence
from pagas_cl.method.surface.raster import each_depth
from pagas_cl.method.surface.subdivide import subdivide as split_edges
from pagas_cl.method.surface.weld import unlike
from pagas_cl.progress import NONE, Progress, Stage, stage
from pagas_cl.runtime.device import open_device
from pagas_cl.scene.mesh import Surface
from pagas_cl.scene.meshes.attributes import with_vertices
from pagas_cl.scene.meshes.files import check_digits, read_content
from pagas_cl.scene.meshes.formats import losses
from pagas_cl.scene.meshes.kinds import to_surface
from pagas_cl.scene.meshes.obj_materials import write_obj
from pagas_cl.scene.view import joined
from pagas_cl.system.files import differing

_MEMORY = 300.0            # MB for the mesh, where more is free: 660 000 triangles;
_MB_PER_PIXEL = 14e-6      # or so many a pixel of all views, where that is more
_PERCENT = 100             # of the mesh's progress
_FITTED, _SOLVED = 0.8, 0.9    # shares of its time, measured: until the triangles are chosen, and until they lie right
_POLISH = 1                # rounds of the solve on a fused mesh, which lies on the depth maps


def check_subdivide(subdivide) -> None:
    """Raise InputError for a `subdivide` that is neither None nor a number of footprints."""
    number = isinstance(subdivide, (int, float)) and not isinstance(subdivide, bool)
    if subdivide is not None and not (number and 0.25 <= subdivide <= 1e6):
        raise InputError(f"subdivide is {short(subdivide)}, expected None or the longest edge in pixel footprints, "
                         "0.25 or more")


def check_memory(memory) -> None:
    """Raise InputError for a `memory` that is neither None nor a number of MB."""
    number = isinstance(memory, (int, float)) and not isinstance(memory, bool)
    if memory is not None and not (number and memory > 0):
        raise InputError(f"memory is {short(memory)}, expected None or MB of host memory, above 0")


def check_flat(flat) -> None:
    """Raise InputError for a `flat` that is no share of a footprint."""
    number = isinstance(flat, (int, float)) and not isinstance(flat, bool)
    if not (number and 0 <= flat <= 100):
        raise InputError(f"flat is {short(flat)}, expected a distance from 0 to 100 pixel footprints")


def kept_mesh(mesh, views, results, config: Config, output: str = "mesh", subdivide: float | None = None,
              flat: float = FLAT, device=None, memory_mb: float | None = None, note: Callable | None = None,
              progress: Progress = NONE, make: Callable = with_vertices):
    """A mesh of the kind of `mesh` (anything that refine_mesh takes; of a path a Surface) with everything that sits on
    it, its vertices where the refined depth maps say. `results` are what refine_views gave.

    "mesh": with as many triangles as the depth maps show detail, split and undone by the rule of surface.mesh_levels
    with `flat` and `subdivide` (1.5) footprints, and solved once more; where no vertex moved, no split is left. In
    `memory_mb` of host memory, or mesh_mb.
    "displace": with the same triangles (surface.mesh_solve), or all edges split that are longer than `subdivide`.
    `note(text)` is a callback with what is wrong with triangles, before and after. `make` makes the mesh, of what
    with_vertices takes.
    """
    check_subdivide(subdivide)
    with stage(progress, "solve the mesh", _PERCENT) as solving:
        return _kept(mesh, views, results, config, output, subdivide, flat, device, memory_mb, note, solving, make)


def _kept(mesh, views, results, config: Config, output: str, subdivide: float | None, flat: float, device,
          memory_mb: float | None, note: Callable | None, solving: Stage, make: Callable):
    """kept_mesh, of arguments that were checked."""
    used = [result for _, result in joined(views, results)]
    surface = given = to_surface(mesh)
    mesh = given if isinstance(mesh, (str, Path)) else mesh
    division, device, cameras = None, solve_device(device), [result.camera for result in used]
    observed, least_views, rounds = sent(Observations(used), device), _least_views(config), ROUNDS
    if output == "mesh" or subdivide is not None:
        finest = footprints(given.vertices, cameras, each_depth(given, cameras, device))
    if output == "mesh":
        most = int((memory_mb or mesh_mb(cameras)) * 1e6 / TRIANGLE_BYTES)
        detail = subdivide or DETAIL
        division, solved, place = fit_mesh(given, observed, device, finest, flat=flat, detail=detail,
                                           least_views=least_views, most=most,
                                           at=lambda share: solving.advance(_FITTED * _PERCENT * share))
        division, surface = undo_splits(division, solved, place, flat, detail)
        rounds = 1
    elif subdivide is not None:
        division = split_edges(given.vertices, given.faces, subdivide * finest)
        surface = Surface(division.vertices(given.vertices), division.faces)
    solved = solve_mesh(surface, observed, device, least_views=least_views, rounds=rounds)
    solving.advance(_PERCENT * _SOLVED)
    before = given.vertices if division is None else division.vertices(given.vertices)
    vertices, faults = without_new(device, given, division, solved.vertices)
    moved = unlike(vertices, before)
    log.debug("mesh: %d of %d vertices moved; %d were held back, since a triangle would have turned over", moved.sum(),
             len(moved), solved.held)
    log.debug("mesh: %s", faults)
    if note:
        note(f"mesh: {faults}")
    if not moved.any():
        log.warning("the mesh is unchanged: nowhere do two refined views agree on where it should be (%d views were "
                    "refined); check its cameras and photos with 'pagas-cl check'",
                    sum(not result.reason for result in used))
        if output == "mesh":      # what was split in between showed no detail
            division, vertices, solved = None, given.vertices, solved.at(np.arange(len(given.vertices)))
    quality = np.where(moved, vertex_confidence(vertices, used), 0) if moved.any() else None
    solving.advance(_PERCENT)
    return make(mesh, vertices, division, quality, {"deviation": solved.deviation, "views": solved.seen})


def _least_views(config: Config) -> int:
    return max(1, config.fusion.agree_views) + 1


def mesh_mb(cameras) -> float:
    """MB of host memory that the mesh of these views may take: more for more pixels."""
    pixels = sum(camera.width * camera.height for camera in cameras)
    return min(available_mb() / 4, max(_MEMORY, _MB_PER_PIXEL * pixels))


def polished(surface: Surface, results, config: Config, device) -> Surface:
    """A fused mesh with its vertices where the depth maps agree: neither ripples nor fringes. Unchanged where the
    device has no room for it, or the results have no deviations."""
    try:
        solved = solve_mesh(surface, Observations(results), device, rounds=_POLISH,
                            least_views=_least_views(config))
    except (DeviceMemoryError, InputError) as error:      # InputError: results that were kept without their deviations
        log.warning("the fused mesh is complete, but its last smoothing step failed: %s", error)
        return surface
    return replace(surface, vertices=solved.vertices,
                   attributes={"deviation": solved.deviation, "views": solved.seen.astype(np.float64)})


class Observations(Sequence):
    """What solve_mesh takes, of DepthResults, read when they are indexed."""

    def __init__(self, results):
        self._results = results

    def __len__(self) -> int:
        return len(self._results)

    def __getitem__(self, index):
        return Observed.of(self._results[index])


def solve_device(device):
    """The device to solve on: that which `device` means (refine_mesh's), the first of several; an error without one."""
    return comparison_device(device) or open_device(None)


def check_kept(path, mesh, allow_loss: bool = False) -> None:
    """Before the work: raise InputError where the mesh of the file `mesh` would lose what `path` cannot keep, its
    coordinates' digits among it, or where files that belong to others have the names of its materials and textures."""
    path, content = Path(path), read_content(mesh)
    check_digits(path, content.surface(), ahead=True)
    lost = losses(content, path)
    if lost and not allow_loss:
        raise InputError(f"--keep-mesh would lose of mesh {str(mesh)!r}: {', '.join(lost)}; pass --allow-loss to go on "
                         "without them" + (", or write an .obj file" if lost == ["texture coordinates"] else ""))
    if lost:
        log.warning("%s will not have of %s: %s", path, mesh, ", ".join(lost))
    if path.suffix.lower() == ".obj":
        with tempfile.TemporaryDirectory() as folder:
            write_obj(Path(folder) / path.name, content.surface())
            taken = differing(Path(folder).iterdir(), path)
        if taken:
            raise InputError(f"--output {str(path)!r}: its materials and textures would replace {taken[0]}, which is "
                             "written by another program; choose another name or folder")
