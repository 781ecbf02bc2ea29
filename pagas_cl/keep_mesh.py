"""`refine_mesh(..., output="displace")`: the given mesh, its vertices on the refined depths, all else as it was."""

from __future__ import annotations

import logging
import os
import tempfile
from pathlib import Path

import numpy as np

from pagas_cl.config import Config
from pagas_cl.errors import InputError
from pagas_cl.result import joined
from pagas_cl.scene.mesh import Surface, to_surface
from pagas_cl.scene.mesh_attributes import load_whole, with_vertices
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
    if path.suffix.lower() != ".obj" or not hasattr(mesh, "has_triangle_uvs") or not mesh.has_triangle_uvs():
        write_mesh(path, to_surface(mesh))
        return
    import open3d as o3d

    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".", suffix=".part", dir=path.parent) as beside:
        if not o3d.io.write_triangle_mesh(str(Path(beside) / path.name), mesh):
            raise InputError(f"Open3D could not write {str(path)!r}")
        for file in sorted(Path(beside).iterdir(), key=lambda f: f.name == path.name):  # the mesh itself last
            os.replace(file, path.parent / file.name)
