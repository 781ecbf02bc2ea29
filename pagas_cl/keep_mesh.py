"""The given mesh, its vertices on the refined depths, all else as it was: `refine_mesh(..., output="mesh")` or
"displace"."""

import glob
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from pagas_cl.config import Config
from pagas_cl.errors import DeviceMemoryError, InputError, log
from pagas_cl.progress import Progress, ViewProgress
from pagas_cl.result import joined
from pagas_cl.runtime.device import open_device
from pagas_cl.scene.files import differing, replaced_with_others
from pagas_cl.scene.mesh import Surface, to_surface
from pagas_cl.scene.mesh_attributes import load_whole, with_vertices
from pagas_cl.scene.mesh_file import write_mesh
from pagas_cl.scene.mesh_losses import losses
from pagas_cl.surface.agree import comparison_device
from pagas_cl.surface.fuse import available_mb
from pagas_cl.surface.mesh_evidence import Observed, sent
from pagas_cl.surface.mesh_faults import without_new
from pagas_cl.surface.mesh_levels import TRIANGLE_BYTES, fit_mesh
from pagas_cl.surface.mesh_solve import ROUNDS, solve_mesh, unlike
from pagas_cl.surface.on_vertices import footprints, vertex_confidence
from pagas_cl.surface.raster import each_depth
from pagas_cl.surface.subdivide import subdivide as split_edges
from pagas_cl.surface.subdivide import undivided

_DETAIL, FLAT = 1.5, 0.04     # footprints: edges that hold what photos show; how flat is flat
_MEMORY, _SHARE = 300.0, 14e-6   # MB for the mesh, where more is free: 660 000 triangles; the same a pixel of all views
_FITTED, _CHECKED = 0.57, 1.2  # measured: of what is left, that of the last level; rounds by time, what follows them
_POLISH = 1                  # rounds of the solve on a fused mesh, which lies on the depth maps


def check_subdivide(subdivide) -> None:
    """Raise InputError for a `subdivide` that is neither None nor a number of footprints."""
    number = isinstance(subdivide, (int, float)) and not isinstance(subdivide, bool)
    if subdivide is not None and not (number and 0.25 <= subdivide <= 1e6):
        raise InputError(f"subdivide is {subdivide!r}, expected None or the longest edge in pixel footprints, "
                         "0.25 or more")


def check_flat(flat) -> None:
    """Raise InputError for a `flat` that is no share of a footprint."""
    number = isinstance(flat, (int, float)) and not isinstance(flat, bool)
    if not (number and 0 <= flat <= 100):
        raise InputError(f"flat is {flat!r}, expected a distance from 0 to 100 pixel footprints")


def kept_mesh(mesh, views, results, config: Config, output: str = "mesh", subdivide: float | None = None,
              flat: float = FLAT, device=None, memory_mb: float | None = None, tell: Callable | None = None,
              progress: Progress | None = None):
    """A mesh of the kind of `mesh` (anything that refine_mesh takes; a path as load_whole reads it) with
    everything that sits on it, its vertices where the refined depth maps say. `results` are what refine_views gave.

    "mesh": with as many triangles as the depth maps show detail (surface.mesh_levels): edges longer than `subdivide`
    (1.5) pixel footprints are split where depth maps lie off them; afterwards splits are undone where the surface is
    flat within `flat` footprints, and the rest is solved once more; where no vertex moved, none is left. In `memory_mb`
    of host memory, or mesh_mb.
    "displace": with the same triangles (surface.mesh_solve), or all edges split that are longer than `subdivide`.
    `tell(text)` is told what is wrong with triangles, before and after.
    """
    solving = ViewProgress(progress, 1, "solve the mesh")
    solving.at(0)
    check_subdivide(subdivide)
    mesh, used = load_whole(mesh), [result for _, result in joined(views, results)]
    surface = given = to_surface(mesh)
    division, device, cameras = None, solve_device(device), [result.camera for result in used]
    observed, least_views, rounds = sent(Observations(used), device), _least_views(config), ROUNDS
    if output == "mesh" or subdivide is not None:
        finest = footprints(given.vertices, cameras, each_depth(given, cameras, device))
    if output == "mesh":
        most = int((memory_mb or mesh_mb(cameras)) * 1e6 / TRIANGLE_BYTES)
        division, surface = _detailed(given, observed, device, finest, subdivide or _DETAIL, flat, least_views, most,
                                      solving.at)
        rounds = 1
        solving.further(_FITTED)
    elif subdivide is not None:
        division = split_edges(given.vertices, given.faces, subdivide * finest)
        surface = Surface(division.vertices(given.vertices), division.faces)
    solved = solve_mesh(surface, observed, device, least_views=least_views, rounds=rounds)
    solving.further(rounds / (rounds + _CHECKED))
    before = given.vertices if division is None else division.vertices(given.vertices)
    vertices, faults = without_new(device, given, division, solved.vertices)
    moved = unlike(vertices, before)
    log.info("mesh: %d of %d vertices moved; %d were held back, since a triangle would have turned over", moved.sum(),
             len(moved), solved.held)
    log.info("mesh: %s", faults)
    if tell:
        tell(f"mesh: {faults}")
    if not moved.any():
        log.warning("no vertex moved: no two refined views agree on any of them (%d views were refined)",
                    sum(not result.reason for result in used))
        if output == "mesh":      # what was split in between showed no detail
            division, vertices, solved = None, given.vertices, solved.at(np.arange(len(given.vertices)))
    quality = np.where(moved, vertex_confidence(vertices, used), 0) if moved.any() else None
    solving.at(1)
    return with_vertices(mesh, vertices, division, quality, {"deviation": solved.deviation, "views": solved.seen})


def _detailed(given: Surface, observed, device, finest, detail: float, flat: float, least_views: int, most: int, at):
    """How `given` is divided as the depth maps show detail, and that mesh, solved but for what undoing splits left."""
    division, solved, place = fit_mesh(given, observed, device, finest, flat=flat, detail=detail,
                                       least_views=least_views, most=most, at=at)
    within, count = flat * detail * solved.unit**2, len(division.faces)
    division, keep = undivided(division, solved.vertices, np.where(np.isfinite(within), within, 0), place)
    log.info("mesh: %d of %d triangles are needed to be within %g footprints", len(division.faces), count, flat)
    return division, Surface(solved.vertices[keep], division.faces)


def _least_views(config: Config) -> int:
    return max(1, config.fusion.agree_views) + 1


def mesh_mb(cameras) -> float:
    """MB of host memory that the mesh of these views may take: more for more pixels."""
    return min(available_mb() / 4, max(_MEMORY, _SHARE * sum(camera.width * camera.height for camera in cameras)))


def polished(surface: Surface, results, config: Config, device) -> Surface:
    """A fused mesh with its vertices where the depth maps agree: neither ripples nor fringes. As it is where the device
    has no room for it, or the results have no deviations."""
    try:
        solved = solve_mesh(surface, Observations(results), device, rounds=_POLISH,
                            least_views=_least_views(config))
    except (DeviceMemoryError, InputError) as error:      # InputError: results that were kept without their deviations
        log.warning("the fused mesh is not polished: %s", error)
        return surface
    return replace(surface, vertices=solved.vertices,
                   attributes={"deviation": solved.deviation, "views": solved.seen.astype(np.float64)})


class Observations(Sequence):
    """What solve_mesh takes, of DepthResults, read when they are asked for."""

    def __init__(self, results):
        self._results = results

    def __len__(self) -> int:
        return len(self._results)

    def __getitem__(self, index):
        return Observed.of(self._results[index])


def solve_device(device):
    """The device to solve on: that which `device` means (refine_mesh's), the first of several; an error without one."""
    return comparison_device(device) or open_device(None)


def write_whole(path, mesh) -> None:
    """Write a mesh of `kept_mesh`, with textures where the kind of file has them, under its final name at once."""
    path = Path(path)
    if not _with_textures(path, mesh):
        write_mesh(path, to_surface(mesh))
        return
    with replaced_with_others(path) as new:
        _write_open3d(new, mesh)


def check_kept(path, mesh, allow_loss: bool = False) -> None:
    """Before the work: raise InputError where the mesh of the file `mesh` would lose what `path` cannot keep, or where
    files that belong to others have the names of its materials and textures."""
    lost = losses(mesh, path) if Path(mesh).is_file() else []
    if lost and not allow_loss:
        raise InputError(f"--keep-mesh would lose of mesh {str(mesh)!r}: {', '.join(lost)}; pass --allow-loss to go on "
                         "without them" + (", or write an .obj file" if lost == ["texture coordinates"] else ""))
    if lost:
        log.warning("%s will not have of %s: %s", path, mesh, ", ".join(lost))
    path = Path(path)
    if path.suffix.lower() == ".obj" and any(path.parent.glob(f"{glob.escape(path.stem)}[._]*")):
        whole = load_whole(mesh)
        with tempfile.TemporaryDirectory() as folder:
            if _with_textures(path, whole):
                _write_open3d(Path(folder) / path.name, whole)
            taken = differing(Path(folder).iterdir(), path)
        if taken:
            raise InputError(f"--output {str(path)!r}: its materials and textures would replace {taken[0]}, which is "
                             "not ours; choose another name or folder")


def _with_textures(path: Path, mesh) -> bool:
    return path.suffix.lower() == ".obj" and hasattr(mesh, "has_triangle_uvs") and mesh.has_triangle_uvs()


def _write_open3d(path: Path, mesh) -> None:
    import open3d as o3d

    if not o3d.io.write_triangle_mesh(str(path), mesh):
        raise InputError(f"Open3D could not write {str(path)!r}")
