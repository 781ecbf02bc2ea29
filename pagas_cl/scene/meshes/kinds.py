"""A Surface from every kind of mesh that users have, and back: Open3D, pymeshlab, arrays, files."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from pagas_cl.errors import InputError, need
from pagas_cl.scene.mesh import Mesh, Surface
from pagas_cl.scene.meshes.files import read_mesh


def to_surface(mesh: Mesh) -> Surface:
    """Surface of any Mesh; of a MeshSet the current mesh, layer matrix applied.

    InputError for an empty mesh, vertices that are not finite, face indices out of range, an unknown kind or an
    unreadable file.
    """
    if isinstance(mesh, (str, Path)):
        return read_mesh(mesh)
    convert: dict[str, Callable[[Any], Surface]] = {
        "surface": lambda surface: surface, "pair": lambda pair: Surface(*pair), "open3d": _from_legacy,
        "open3d.t": _from_tensor, "pymeshlab": _from_pymeshlab}
    return convert[mesh_kind(mesh)](mesh)


def from_surface(surface: Surface, like: Mesh) -> Mesh:
    """`surface` as a new mesh of the kind that `like` is (a path gives the Surface itself).

    pymeshlab keeps colours in 8 bits and makes its own normals.
    """
    kind = "surface" if isinstance(like, (str, Path)) else mesh_kind(like)
    if kind == "surface":
        return surface
    if kind == "pair":
        return surface.vertices.copy(), surface.faces.copy()
    if kind == "open3d.t":
        return _to_tensor(surface, like)
    return _to_legacy(surface) if kind == "open3d" else _to_pymeshlab(surface)


def mesh_kind(mesh: Mesh) -> str:
    """"surface", "open3d", "open3d.t", "pymeshlab" or "pair"; InputError for anything else. Imports none of them."""
    if isinstance(mesh, Surface):
        return "surface"
    module, name = type(mesh).__module__, type(mesh).__name__
    if module.startswith("open3d") and name == "TriangleMesh":
        return "open3d.t" if ".t." in module or hasattr(mesh, "vertex") else "open3d"
    if module.startswith("pymeshlab") and name in ("Mesh", "MeshSet"):
        return "pymeshlab"
    if isinstance(mesh, (tuple, list)) and len(mesh) == 2:
        return "pair"
    raise InputError(f"mesh is a {module}.{name}, expected an Open3D TriangleMesh (legacy or tensor), a "
                     "pymeshlab.Mesh, a pair (vertices, faces) or the path of a mesh file")


def current_mesh(mesh: Mesh) -> Mesh:
    """Of pymeshlab's MeshSet the current mesh, else the mesh itself."""
    if hasattr(mesh, "current_mesh") and mesh.mesh_number() == 0:
        raise InputError("the mesh is empty: a pymeshlab MeshSet without meshes")
    return mesh.current_mesh() if hasattr(mesh, "current_mesh") else mesh


def _from_legacy(mesh: Any) -> Surface:
    return Surface(np.asarray(mesh.vertices), np.asarray(mesh.triangles),
                   np.array(mesh.vertex_normals) if mesh.has_vertex_normals() else None,
                   np.array(mesh.vertex_colors) if mesh.has_vertex_colors() else None)


def _to_legacy(surface: Surface) -> Mesh:
    o3d = need("open3d", "mesh", "making an Open3D mesh")
    mesh = o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(surface.vertices),
                                     o3d.utility.Vector3iVector(surface.faces))
    if surface.normals is not None:
        mesh.vertex_normals = o3d.utility.Vector3dVector(surface.normals)
    if surface.colors is not None:
        mesh.vertex_colors = o3d.utility.Vector3dVector(surface.colors)
    return mesh


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


def _to_tensor(surface: Surface, like: Mesh) -> Mesh:
    o3d = need("open3d", "mesh", "making an Open3D mesh")
    mesh = o3d.t.geometry.TriangleMesh()
    mesh.vertex["positions"] = positions(surface.vertices, like)
    mesh.triangle["indices"] = o3d.core.Tensor(surface.faces.astype(np.int64))
    quality = None if surface.quality is None else surface.quality[:, None]
    more = [(name, np.asarray(value)[:, None]) for name, value in surface.attributes.items()]
    for name, value in (("normals", surface.normals), ("colors", surface.colors), ("quality", quality), *more):
        if value is not None:
            mesh.vertex[name] = o3d.core.Tensor(value.astype(np.float32))
    return mesh


def positions(vertices: np.ndarray, like: Mesh) -> Any:
    """Vertices (V, 3) as an Open3D Tensor: float32 where `like` is and no millionth of the mesh's size is lost."""
    core = need("open3d", "mesh", "making an Open3D mesh").core
    single = "positions" in like.vertex and like.vertex["positions"].dtype == core.float32
    fits = np.abs(vertices).max() * 2.0**-24 < 1e-6 * np.ptp(vertices, axis=0).max()
    return core.Tensor(vertices.astype(np.float32 if single and fits else np.float64))


def _from_pymeshlab(mesh: Any) -> Surface:
    mesh = current_mesh(mesh)
    if mesh.vertex_number() == 0 or mesh.face_number() == 0:
        raise InputError(f"the mesh is empty: {mesh.vertex_number()} vertices and {mesh.face_number()} faces")
    vertices = mesh.transformed_vertex_matrix()  # with the layer's matrix, which vertex_matrix() leaves out
    colors = mesh.vertex_color_matrix()[:, :3] if mesh.has_vertex_color() else None
    quality = mesh.vertex_scalar_array() if mesh.has_vertex_scalar() else None
    return Surface(vertices, mesh.face_matrix(), None, colors, quality)


def _to_pymeshlab(surface: Surface) -> Mesh:
    pymeshlab = need("pymeshlab", "meshlab", "making a pymeshlab mesh")
    colors = surface.colors
    if colors is not None:
        colors = eight_bits(np.column_stack([colors, np.ones(len(colors))]))
    more = {"v_normals_matrix": surface.normals, "v_color_matrix": colors, "v_scalar_array": surface.quality}
    mesh = pymeshlab.Mesh(surface.vertices, surface.faces, **{k: v for k, v in more.items() if v is not None})
    for name, value in surface.attributes.items():
        mesh.add_vertex_custom_scalar_attribute(np.ascontiguousarray(value, np.float64), name)
    return mesh


def eight_bits(colors: np.ndarray) -> np.ndarray:
    """Colours of 0 to 1 such that pymeshlab, which truncates to 8 bits, keeps them: whole numbers of 255."""
    whole: np.ndarray = np.rint(np.clip(colors, 0, 1) * 255)
    return whole / 255
