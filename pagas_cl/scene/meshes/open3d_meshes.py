"""Open3D's triangle meshes, legacy and tensor, as kinds of mesh."""

import copy
from typing import Any

import numpy as np

from pagas_cl.errors import InputError, need
from pagas_cl.scene.mesh import Change, Mesh, MeshKind, Surface

_DOING = "making an Open3D mesh"


def _from_legacy(mesh: Any) -> Surface:
    return Surface(np.asarray(mesh.vertices), np.asarray(mesh.triangles),
                   np.array(mesh.vertex_normals) if mesh.has_vertex_normals() else None,
                   np.array(mesh.vertex_colors) if mesh.has_vertex_colors() else None)


def _to_legacy(surface: Surface, like: Any) -> Mesh:
    o3d = need("open3d", "mesh", _DOING)
    mesh = o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(surface.vertices),
                                     o3d.utility.Vector3iVector(surface.faces))
    if surface.normals is not None:
        mesh.vertex_normals = o3d.utility.Vector3dVector(surface.normals)
    if surface.colors is not None:
        mesh.vertex_colors = o3d.utility.Vector3dVector(surface.colors)
    return mesh


def _changed_legacy(mesh: Any, change: Change) -> Mesh:
    utility = need("open3d", "mesh", _DOING).utility
    new, split, colors = copy.deepcopy(mesh), change.split, change.colors
    new.vertices = utility.Vector3dVector(change.vertices)
    if split.faces is not None:
        new.triangles = utility.Vector3iVector(split.faces)
        if mesh.has_adjacency_list():
            new.compute_adjacency_list()
    if colors is None and mesh.has_vertex_colors():
        colors = split.vertices(np.asarray(mesh.vertex_colors))
    if colors is not None:
        new.vertex_colors = utility.Vector3dVector(colors)
    if mesh.has_triangle_uvs():
        places = np.asarray(mesh.triangle_uvs).reshape(-1, 3, 2)
        new.triangle_uvs = utility.Vector2dVector(split.corners(places).reshape(-1, 2))
    if mesh.has_triangle_material_ids():
        new.triangle_material_ids = utility.IntVector(split.on_faces(np.asarray(mesh.triangle_material_ids)))
    if mesh.has_triangle_normals():
        new.compute_triangle_normals()
    if mesh.has_vertex_normals():
        new.vertex_normals = utility.Vector3dVector(np.zeros((0, 3)))
        new.compute_vertex_normals()
    return new


def _from_tensor(mesh: Any) -> Surface:
    if "positions" not in mesh.vertex or "indices" not in mesh.triangle:
        raise InputError("the mesh is empty: an Open3D tensor mesh without vertex positions or triangle indices")
    take = {name: mesh.vertex[name].cpu().numpy() for name in ("positions", "normals", "colors", "quality")
            if name in mesh.vertex}
    colors = take.get("colors")
    if colors is not None and colors.dtype.kind in "iu":
        colors = colors / float(np.iinfo(colors.dtype).max)
    quality = take["quality"].reshape(len(take["quality"])) if "quality" in take else None
    return Surface(take["positions"], mesh.triangle["indices"].cpu().numpy(), take.get("normals"), colors, quality)


def _to_tensor(surface: Surface, like: Any) -> Mesh:
    o3d = need("open3d", "mesh", _DOING)
    mesh = o3d.t.geometry.TriangleMesh()
    mesh.vertex["positions"] = positions(surface.vertices, like)
    mesh.triangle["indices"] = o3d.core.Tensor(surface.faces.astype(np.int64))
    for name, value in [("normals", surface.normals), ("colors", surface.colors), ("quality", surface.quality),
                        *surface.attributes.items()]:
        if value is not None:
            mesh.vertex[name] = o3d.core.Tensor(np.asarray(value, np.float32).reshape(len(value), -1))
    return mesh


def positions(vertices: np.ndarray, like: Any) -> Any:
    """Vertices (V, 3) as an Open3D Tensor: float32 where `like` is and no millionth of the mesh's size is lost."""
    core = need("open3d", "mesh", _DOING).core
    single = "positions" in like.vertex and like.vertex["positions"].dtype == core.float32
    fits = np.abs(vertices).max() * 2.0**-24 < 1e-6 * np.ptp(vertices, axis=0).max()
    return core.Tensor(vertices.astype(np.float32 if single and fits else np.float64))


def _changed_tensor(mesh: Any, change: Change) -> Mesh:
    core = need("open3d", "mesh", _DOING).core
    new, split = mesh.clone(), change.split
    new.material = mesh.material       # which clone() leaves out
    for name in set(mesh.vertex) - {"positions", "normals"}:
        values = mesh.vertex[name].cpu().numpy()
        if name == "colors" and values.dtype.kind in "iu":      # they have a mean; other whole numbers name something
            new.vertex[name] = core.Tensor(np.rint(split.vertices(values.astype(float))).astype(values.dtype))
        else:
            new.vertex[name] = core.Tensor(split.vertices(values))
    for name in set(mesh.triangle) - {"indices", "normals"}:
        carried = split.corners if name == "texture_uvs" else split.on_faces
        new.triangle[name] = core.Tensor(carried(mesh.triangle[name].cpu().numpy()))
    new.vertex["positions"] = positions(change.vertices, mesh)
    if split.faces is not None:
        new.triangle["indices"] = core.Tensor(split.faces.astype(np.int64))
    if change.colors is not None:
        new.vertex["colors"] = core.Tensor(change.colors.astype(np.float32))
    for name, values in [("quality", change.quality), *change.attributes.items()]:
        if values is not None:
            new.vertex[name] = core.Tensor(values[:, None].astype(np.float32))
    for holder in (new.vertex, new.triangle):
        if "normals" in holder:
            del holder["normals"]
    if "normals" in mesh.vertex:
        new.compute_vertex_normals()       # those of triangles, too; after these Open3D warns that there are none
    elif "normals" in mesh.triangle:
        new.compute_triangle_normals()
    return new


LEGACY = MeshKind(_from_legacy, _to_legacy, _changed_legacy,
                  sits_on=lambda mesh: ({"colors"} if mesh.has_vertex_colors() else set(),
                                        mesh.has_triangle_uvs() or mesh.has_triangle_material_ids()))
TENSOR = MeshKind(_from_tensor, _to_tensor, _changed_tensor,
                  sits_on=lambda mesh: (set(mesh.vertex), bool(set(mesh.triangle) - {"indices", "normals"})),
                  has_quality=lambda mesh: "quality" in mesh.vertex)
