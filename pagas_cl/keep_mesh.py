"""`refine_mesh(..., output="displace")`: the given mesh, its vertices on the refined depths, all else as it was."""

from __future__ import annotations

import glob
import logging
import tempfile
from pathlib import Path

import numpy as np

from pagas_cl.config import Config
from pagas_cl.errors import InputError
from pagas_cl.result import joined
from pagas_cl.scene.files import differing, replaced_with_others
from pagas_cl.scene.mesh import Surface, to_surface
from pagas_cl.scene.mesh_attributes import load_whole, with_vertices
from pagas_cl.scene.mesh_losses import losses
from pagas_cl.scene.view import View

log = logging.getLogger("pagas_cl")


def check_subdivide(subdivide) -> None:
    """Raise InputError for a `subdivide` that is neither None nor a number of footprints."""
    number = isinstance(subdivide, (int, float)) and not isinstance(subdivide, bool)
    if subdivide is not None and not (number and 0.25 <= subdivide <= 1e6):
        raise InputError(f"subdivide is {subdivide!r}, expected None or the longest edge in pixel footprints, "
                         "0.25 or more")


def displaced_mesh(mesh, views: list[View], depths, results, config: Config, subdivide: float | None = None):
    """A mesh of the kind of `mesh` with the same topology (or split edges) and everything that sits on it.

    `mesh` is anything that refine_mesh takes; a path comes back as an Open3D legacy mesh. `depths` and `results` are
    what refine_views took and gave. First, edges are split that are longer than `subdivide` pixel footprints (of the
    finest view that sees them).
    """
    from pagas_cl.surface.displace import displace, footprints
    from pagas_cl.surface.subdivide import subdivide as split_edges

    check_subdivide(subdivide)
    mesh = load_whole(mesh)
    surface, division = to_surface(mesh), None
    observed = observed_views(views, depths, results)
    if subdivide is not None:
        finest = footprints(surface.vertices, [o.camera for o in observed], [o.initial for o in observed])
        division = split_edges(surface.vertices, surface.faces, subdivide * finest)
        surface = Surface(division.vertices(surface.vertices), division.faces)
    moved = displace(surface, observed, agree_views=config.fusion.agree_views, agree_pixels=config.fusion.agree_pixels)
    if not moved.moved.any():
        log.warning("no vertex moved: no two refined views agree on any of them (%d views were refined)",
                    sum(not result.reason for result in results))
    return with_vertices(mesh, moved.vertices, division, moved.quality)


def observed_views(views: list[View], depths, results) -> list:
    """What surface.displace takes, of what refine_views took and gave."""
    from pagas_cl.surface.displace import Observed

    return [Observed(r.camera, np.asarray(depths[place]), r.depth, r.parallax, r.confidence)
            for place, r in joined(views, results)]


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
