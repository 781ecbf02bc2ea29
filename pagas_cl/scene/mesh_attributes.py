"""A mesh with its vertices elsewhere and everything else as it was: textures, colours, attributes, Open3D or pymeshlab.

Beside `scene.mesh`, whose `Surface` carries no texture coordinates. Normals are the only thing made anew.
"""

from __future__ import annotations

import copy
import logging
from pathlib import Path
from typing import Any

import numpy as np

from pagas_cl.errors import InputError, need
from pagas_cl.scene.mesh import Mesh, Surface, mesh_kind

log = logging.getLogger("pagas_cl")


def load_whole(mesh: Mesh) -> Mesh:
    """A path as an Open3D legacy mesh with its textures; anything else as it is."""
    if not isinstance(mesh, (str, Path)):
        return mesh
    path = Path(mesh)
    if not path.is_file():
        raise InputError(f"mesh {str(path)!r} does not exist")
    o3d = need("open3d", "mesh", "reading a mesh file")
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        found = o3d.io.read_triangle_mesh(str(path), True)
    if len(found.vertices) == 0:
        raise InputError(f"mesh {str(path)!r} has no vertices, or is no mesh file that Open3D reads")
    return found


def with_vertices(mesh: Mesh, vertices: np.ndarray, subdivision: Any = None,
                  quality: np.ndarray | None = None) -> Mesh:
    """A new mesh of `mesh`'s kind with `vertices`, its faces split as `subdivision` says, all else carried along.

    Parameters
    ----------
    mesh : Open3D TriangleMesh (legacy or tensor), pymeshlab.Mesh, (vertices, faces), or Surface
    vertices : ndarray of shape (V', 3), float64, world coordinates
    subdivision : surface.subdivide.Subdivision, optional
    quality : ndarray of shape (V',), optional
        Vertex quality, for the kinds that have one.
    """
    carry: Any = subdivision or _Same()
    if isinstance(mesh, Surface):
        return Surface(vertices, carry.faces_of(mesh.faces) if subdivision is None else subdivision.faces, None,
                       None if mesh.colors is None else carry.vertices(mesh.colors),
                       quality if quality is not None else mesh.quality)
    kind = mesh_kind(mesh)
    if kind == "pair":
        return vertices, np.array(mesh[1]) if subdivision is None else subdivision.faces
    return {"open3d": _legacy, "open3d.t": _tensor, "pymeshlab": _pymeshlab}[kind](mesh, vertices, subdivision, carry,
                                                                                   quality)


class _Same:
    """A subdivision that splits nothing."""

    def faces_of(self, faces: np.ndarray) -> np.ndarray:
        return faces

    def vertices(self, values: np.ndarray) -> np.ndarray:
        return values

    corners = on_faces = vertices


def _legacy(mesh: Mesh, vertices: np.ndarray, subdivision: Any, carry: Any,
            quality: np.ndarray | None) -> Mesh:
    o3d = need("open3d", "mesh", "making an Open3D mesh")
    new = copy.deepcopy(mesh)
    new.vertices = o3d.utility.Vector3dVector(vertices)
    if subdivision is not None:
        new.triangles = o3d.utility.Vector3iVector(subdivision.faces)
        if mesh.has_vertex_colors():
            new.vertex_colors = o3d.utility.Vector3dVector(carry.vertices(np.asarray(mesh.vertex_colors)))
        if mesh.has_triangle_uvs():
            corners = np.asarray(mesh.triangle_uvs).reshape(-1, 3, 2)
            new.triangle_uvs = o3d.utility.Vector2dVector(carry.corners(corners).reshape(-1, 2))
        if mesh.has_triangle_material_ids():
            new.triangle_material_ids = o3d.utility.IntVector(carry.on_faces(np.asarray(mesh.triangle_material_ids)))
    if mesh.has_triangle_normals():
        new.compute_triangle_normals()
    if mesh.has_vertex_normals():
        new.vertex_normals = o3d.utility.Vector3dVector(np.zeros((0, 3)))
        new.compute_vertex_normals()
    return new


def _tensor(mesh: Mesh, vertices: np.ndarray, subdivision: Any, carry: Any,
            quality: np.ndarray | None) -> Mesh:
    o3d = need("open3d", "mesh", "making an Open3D mesh")
    new = mesh.clone()
    corner_like = {"texture_uvs"}
    for name in list(mesh.vertex):
        if name not in ("positions", "normals"):
            new.vertex[name] = o3d.core.Tensor(carry.vertices(mesh.vertex[name].cpu().numpy()))
    for name in list(mesh.triangle):
        if name not in ("indices", "normals"):
            values = mesh.triangle[name].cpu().numpy()
            new.triangle[name] = o3d.core.Tensor((carry.corners if name in corner_like else carry.on_faces)(values))
    given = mesh.vertex["positions"].dtype.__str__()
    span = np.ptp(vertices, axis=0).max()
    single = "32" in given and np.abs(vertices).max() * 2.0**-24 < 1e-6 * span
    new.vertex["positions"] = o3d.core.Tensor(vertices.astype(np.float32 if single else np.float64))
    if subdivision is not None:
        new.triangle["indices"] = o3d.core.Tensor(subdivision.faces.astype(np.int64))
    if quality is not None:
        new.vertex["quality"] = o3d.core.Tensor(quality[:, None].astype(np.float32))
    for holder, compute in ((new.triangle, new.compute_triangle_normals), (new.vertex, new.compute_vertex_normals)):
        if "normals" in holder:
            del holder["normals"]
            compute()
    return new


def _pymeshlab(mesh: Mesh, vertices: np.ndarray, subdivision: Any, carry: Any,
               quality: np.ndarray | None) -> Mesh:
    pymeshlab = need("pymeshlab", "meshlab", "making a pymeshlab mesh")
    mesh = mesh.current_mesh() if hasattr(mesh, "current_mesh") else mesh
    more = {}
    if mesh.has_vertex_color():
        more["v_color_matrix"] = _eight_bits(carry.vertices(mesh.vertex_color_matrix()))
    if mesh.has_face_color():
        more["f_color_matrix"] = _eight_bits(carry.on_faces(mesh.face_color_matrix()))
    if mesh.has_face_scalar():
        more["f_scalar_array"] = carry.on_faces(mesh.face_scalar_array())
    if mesh.has_vertex_tex_coord():
        more["v_tex_coords_matrix"] = carry.vertices(mesh.vertex_tex_coord_matrix())
    if mesh.has_wedge_tex_coord():
        corners = mesh.wedge_tex_coord_matrix().reshape(-1, 3, 2)
        more["w_tex_coords_matrix"] = carry.corners(corners).reshape(-1, 2)
    if quality is not None:
        more["v_scalar_array"] = quality
    elif mesh.has_vertex_scalar():
        more["v_scalar_array"] = carry.vertices(mesh.vertex_scalar_array())
    if mesh.texture_number():
        log.info("a new pymeshlab.Mesh cannot be given textures: its texture coordinates are kept, the %d texture "
                 "images must be set again (set_texture_per_mesh); the MeshSet step keeps them", mesh.texture_number())
    faces = mesh.face_matrix() if subdivision is None else subdivision.faces
    return pymeshlab.Mesh(vertices, faces, **more)


def _eight_bits(colors: np.ndarray) -> np.ndarray:
    whole: np.ndarray = np.rint(np.clip(colors, 0, 1) * 255)  # pymeshlab truncates to 8 bits: give it whole ones
    return whole / 255
