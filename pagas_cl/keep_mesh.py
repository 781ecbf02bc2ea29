"""The given mesh, its vertices on the refined depths, all else as it was: `refine_mesh(..., output="mesh")` or
"displace"."""

from __future__ import annotations

import glob
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from pagas_cl.config import Config
from pagas_cl.errors import DeviceMemoryError, InputError, log
from pagas_cl.result import joined
from pagas_cl.scene.files import differing, replaced_with_others
from pagas_cl.scene.mesh import Surface, to_surface
from pagas_cl.scene.mesh_attributes import load_whole, with_vertices
from pagas_cl.scene.mesh_losses import losses
from pagas_cl.scene.view import View

DETAIL, FLAT = 1.5, 0.05     # footprints: edges that hold what photos show; how flat is flat
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


def displaced_mesh(mesh, views: list[View], depths, results, config: Config, subdivide: float | None = None,
                   flat: float = 0.0, device=None):
    """A mesh of the kind of `mesh` with the same topology (or split edges) and everything that sits on it, its vertices
    where the refined depth maps say (surface.mesh_solve).

    `mesh` is anything that refine_mesh takes; a path comes back as an Open3D legacy mesh. `depths` and `results` are
    what refine_views took and gave. First, edges are split that are longer than `subdivide` pixel footprints (of the
    finest view that sees them); afterwards splits are undone where the surface is flat within `flat` footprints.
    """
    from pagas_cl.surface.mesh_solve import solve_mesh
    from pagas_cl.surface.on_vertices import footprints, vertex_confidence
    from pagas_cl.surface.subdivide import subdivide as split_edges
    from pagas_cl.surface.subdivide import undivided

    check_subdivide(subdivide)
    mesh = load_whole(mesh)
    given = surface = to_surface(mesh)
    seen_by = joined(views, results)
    cameras, initial = [r.camera for _, r in seen_by], [np.asarray(depths[place]) for place, _ in seen_by]
    finest = footprints(surface.vertices, cameras, initial)
    division = None
    if subdivide is not None:
        division = split_edges(surface.vertices, surface.faces, subdivide * finest)
        surface = Surface(division.vertices(surface.vertices), division.faces)
    solved = solve_mesh(surface, Observations([r for _, r in seen_by], coarseness(given, finest, subdivide)),
                        solve_device(device), least_views=max(1, config.fusion.agree_views) + 1)
    moved = (solved.vertices != surface.vertices).any(axis=1)
    log.info("mesh: %d of %d vertices moved; %d were held back, since a triangle would have turned over", moved.sum(),
             len(moved), solved.held)
    if not moved.any():
        log.warning("no vertex moved: no two refined views agree on any of them (%d views were refined)",
                    sum(not result.reason for result in results))
    keep = np.arange(len(moved))
    if division is not None and flat > 0:
        unit = footprints(solved.vertices, cameras, initial)
        unit = np.where(np.isfinite(unit), unit, 0)
        division, keep = undivided(given.faces, division, solved.vertices, flat * unit)
        log.info("mesh: %d of %d triangles are needed to be true within %g footprints", len(division.faces),
                 len(surface.faces), flat)
    quality = np.where(moved, vertex_confidence(solved.vertices, [r for _, r in seen_by]), 0)
    return with_vertices(mesh, solved.vertices[keep], division, quality[keep],
                         {"deviation": solved.deviation[keep], "views": solved.seen[keep]})


def polished(surface: Surface, results, config: Config, device) -> Surface:
    """A fused mesh with its vertices where the depth maps agree: neither ripples nor fringes. As it is where the device
    has no room for it, or the results have no deviations."""
    from pagas_cl.surface.mesh_solve import solve_mesh

    try:
        solved = solve_mesh(surface, Observations(results), device, rounds=_POLISH,
                            least_views=max(1, config.fusion.agree_views) + 1)
    except (DeviceMemoryError, InputError) as error:      # InputError: results that were kept without their deviations
        log.warning("the fused mesh is not polished: %s", error)
        return surface
    return replace(surface, vertices=solved.vertices,
                   attributes={"deviation": solved.deviation, "views": solved.seen.astype(np.float64)})


class Observations(Sequence):
    """What solve_mesh takes, of DepthResults, read when they are asked for; at 1 / `cells` of their size."""

    def __init__(self, results, cells: int = 1):
        self._results, self._cells = results, cells

    def __len__(self) -> int:
        return len(self._results)

    def __getitem__(self, index):
        from pagas_cl.surface.mesh_evidence import Observed

        return Observed.of(self._results[index], self._cells)


def coarseness(surface: Surface, finest: np.ndarray, subdivide: float | None) -> int:
    """Pixels that a vertex stands for, along a line: half the median edge that views see, or what it is split to."""
    ends = surface.vertices[surface.faces[:, [0, 1]]]
    length = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1) / finest[surface.faces[:, 0]]
    found = length[length > 0]
    edge = float(np.median(found)) if len(found) else 1.0
    return max(1, int(min(edge, subdivide or np.inf) / 2))


def solve_device(device):
    """The device to solve on: that which `device` means (refine_mesh's), the first of several; an error without one."""
    from pagas_cl.runtime.device import open_device
    from pagas_cl.surface.agree import comparison_device

    return comparison_device(device) or open_device(None)


def write_whole(path, mesh) -> None:
    """Write a mesh of `displaced_mesh`, with textures where the kind of file has them, under its final name at once."""
    from pagas_cl.scene.mesh_file import write_mesh

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
