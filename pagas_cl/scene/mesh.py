"""A triangle mesh in float64, and its ways to and from Open3D, pymeshlab, arrays and files."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from pagas_cl.errors import InputError, need

# What a user's mesh may be: an Open3D TriangleMesh (legacy or tensor), a pymeshlab Mesh or MeshSet, a pair (vertices,
# faces), a Surface, or the path of a file. Open3D and pymeshlab are optional, so that it cannot be said in types.
Mesh: TypeAlias = Any

_FARTHEST = 1e15         # of a coordinate: a device's float32 holds its square, and distances of it to others
_BLOCK = 1 << 12         # triangles at a time that are looked at for one with an area


@dataclass(frozen=True)
class Material:
    """What an .obj file's library says of a material: statements, each with the image that it ends in or None."""

    name: str
    statements: tuple[tuple[str, Path | None], ...] = ()


@dataclass(frozen=True, eq=False)
class Texture:
    """What the faces of a Surface have beside corners: `coordinates` (F, 3, 2) of each corner in an image, NaN where a
    face has none (or None, where no face has any), and which of the `library` is its material, (F,)."""

    coordinates: npt.NDArray[np.float64] | None
    materials: npt.NDArray[np.int32]
    library: tuple[Material, ...]


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangle mesh, world coordinates, scene units.

    Vertices and normals are (V, 3), colors (V, 3) from 0 to 1, faces (F, 3) 0-based; quality (V,) is MeshLab's vertex
    quality, where our confidence goes; attributes are further numbers (V,) by name; texture is what an .obj file has.
    """

    vertices: npt.NDArray[np.float64] = field(repr=False)
    faces: npt.NDArray[np.int32] = field(repr=False)
    normals: npt.NDArray[np.float64] | None = field(default=None, repr=False)
    colors: npt.NDArray[np.float64] | None = field(default=None, repr=False)
    quality: npt.NDArray[np.float64] | None = field(default=None, repr=False)
    attributes: dict[str, npt.NDArray[np.float64]] = field(default_factory=dict, repr=False)
    texture: Texture | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        vertices, faces = _checked(self.vertices, self.faces)
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces)
        for name, shape in (("normals", (len(vertices), 3)), ("colors", (len(vertices), 3)),
                            ("quality", (len(vertices),))):
            value = getattr(self, name)
            if value is not None:
                value = np.asarray(value, np.float64)
                if value.shape != shape:
                    raise InputError(f"mesh {name} have shape {value.shape}, expected {shape}, one a vertex")
                object.__setattr__(self, name, value)
        for name, value in self.attributes.items():
            if np.shape(value) != (len(vertices),):
                raise InputError(f"mesh attribute {name!r} has shape {np.shape(value)}, expected {(len(vertices),)}, "
                                 "one a vertex")

    def __repr__(self) -> str:
        return f"Surface({len(self.vertices)} vertices, {len(self.faces)} faces)"


def to_surface(mesh: Mesh) -> Surface:
    """Surface of any Mesh; of a MeshSet the current mesh, layer matrix applied.

    InputError for an empty mesh, vertices that are not finite, face indices out of range, an unknown kind or an
    unreadable file.
    """
    if isinstance(mesh, Surface):
        return mesh
    if isinstance(mesh, (str, Path)):
        from pagas_cl.scene.mesh_file import read_mesh

        return read_mesh(mesh)
    kind = mesh_kind(mesh)
    if kind == "pair":
        return Surface(*mesh)
    return {"open3d": from_legacy, "open3d.t": _from_tensor, "pymeshlab": _from_pymeshlab}[kind](mesh)


def from_surface(surface: Surface, like: Mesh) -> Mesh:
    """`surface` as a new mesh of the kind that `like` is (a path gives the Surface itself).

    pymeshlab keeps colours in 8 bits and makes its own normals.
    """
    if isinstance(like, (str, Path, Surface)):
        return surface
    kind = mesh_kind(like)
    if kind == "pair":
        return surface.vertices.copy(), surface.faces.copy()
    return {"open3d": to_legacy, "open3d.t": _to_tensor, "pymeshlab": _to_pymeshlab}[kind](surface, like)


def mesh_kind(mesh: Mesh) -> str:
    """"open3d", "open3d.t", "pymeshlab" or "pair"; InputError for anything else. Imports none of them."""
    module, name = type(mesh).__module__, type(mesh).__name__
    if module.startswith("open3d") and name == "TriangleMesh":
        return "open3d.t" if ".t." in module or hasattr(mesh, "vertex") else "open3d"
    if module.startswith("pymeshlab") and name in ("Mesh", "MeshSet"):
        return "pymeshlab"
    if isinstance(mesh, (tuple, list)) and len(mesh) == 2:
        return "pair"
    raise InputError(f"mesh is a {module}.{name}, expected an Open3D TriangleMesh (legacy or tensor), a "
                     "pymeshlab.Mesh, a pair (vertices, faces) or the path of a mesh file")


def _checked(vertices: Any, faces: Any) -> tuple[np.ndarray, np.ndarray]:
    try:
        vertices, faces = np.ascontiguousarray(vertices, np.float64), np.asarray(faces)
    except (TypeError, ValueError) as error:
        raise InputError("mesh vertices and faces must be arrays of numbers of shape (V, 3) and (F, 3)") from error
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise InputError(f"mesh vertices have shape {vertices.shape}, expected (V, 3)")
    if faces.size == 0:
        faces = faces.reshape(0, 3).astype(np.int32)
    if faces.ndim != 2 or faces.shape[1] != 3:
        raise InputError(f"mesh faces have shape {faces.shape}, expected (F, 3): triangulate the mesh first")
    if faces.dtype.kind not in "iu":
        raise InputError(f"mesh faces have dtype {faces.dtype}, expected integers")
    if len(vertices) == 0 or len(faces) == 0:
        cloud = "; a point cloud has to be made a mesh first (Poisson reconstruction, say)" if len(vertices) else ""
        raise InputError(f"the mesh is empty: {len(vertices)} vertices and {len(faces)} faces{cloud}")
    if not np.isfinite(vertices).all():
        bad = ~np.isfinite(vertices).all(axis=1)
        raise InputError(f"mesh vertex {int(np.argmax(bad))} is not finite ({int(bad.sum())} of {len(vertices)} are "
                         "not): remove them first")
    far = np.abs(vertices).max(axis=1)
    if far.max() > _FARTHEST:
        raise InputError(f"mesh vertex {int(far.argmax())} has a coordinate of {far.max():g} (half of all vertices are "
                         f"within {np.median(far):g}), expected at most {_FARTHEST:g}: remove it first")
    low, high = int(faces.min()), int(faces.max())
    if low < 0 or high >= len(vertices):
        raise InputError(f"a mesh face names vertex {low if low < 0 else high}, expected 0 to {len(vertices) - 1}")
    blocks = (faces[start:start + _BLOCK] for start in range(0, len(faces), _BLOCK))
    if not any(triangle_normals(vertices, block).any() for block in blocks):
        raise InputError(f"none of the mesh's {len(faces)} triangles has an area: their corners are in one place, or "
                         "on a line")
    return vertices, np.ascontiguousarray(faces, np.int32)


def triangle_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Normals of the triangles, as long as twice their area: float64 (F, 3)."""
    return np.cross(*(vertices[faces[:, k]] - vertices[faces[:, 0]] for k in (1, 2)))


def grid_faces(across: int, down: int) -> np.ndarray:
    """Triangles (F, 3) of a grid of `down` rows of `across` vertices."""
    index = np.arange(across * down).reshape(down, across)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]))
    return np.concatenate([np.stack([a, c, b], axis=1), np.stack([b, c, d], axis=1)])


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Sum of the normals of the triangles around each vertex, as long as twice their area: float64 (V, 3)."""
    across = triangle_normals(vertices, faces)
    return np.stack([np.bincount(faces.T.ravel(), np.tile(across[:, k], 3), len(vertices)) for k in range(3)], axis=1)


def from_legacy(mesh: Any) -> Surface:
    return Surface(np.asarray(mesh.vertices), np.asarray(mesh.triangles),
                   np.array(mesh.vertex_normals) if mesh.has_vertex_normals() else None,
                   np.array(mesh.vertex_colors) if mesh.has_vertex_colors() else None)


def to_legacy(surface: Surface, like: Mesh = None) -> Mesh:
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
    if hasattr(mesh, "current_mesh"):
        if mesh.mesh_number() == 0:
            raise InputError("the mesh is empty: a pymeshlab MeshSet without meshes")
        mesh = mesh.current_mesh()
    if mesh.vertex_number() == 0 or mesh.face_number() == 0:
        raise InputError(f"the mesh is empty: {mesh.vertex_number()} vertices and {mesh.face_number()} faces")
    vertices = mesh.transformed_vertex_matrix()  # with the layer's matrix, which vertex_matrix() leaves out
    colors = mesh.vertex_color_matrix()[:, :3] if mesh.has_vertex_color() else None
    quality = mesh.vertex_scalar_array() if mesh.has_vertex_scalar() else None
    return Surface(vertices, mesh.face_matrix(), None, colors, quality)


def _to_pymeshlab(surface: Surface, like: Mesh = None) -> Mesh:
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
