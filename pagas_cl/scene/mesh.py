"""A triangle mesh in float64, and what each kind of mesh that users have says of its way to it and back."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

from pagas_cl.errors import InputError
from pagas_cl.scene.images import as_array

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
    """What the faces of a Surface have besides corners: `coordinates` (F, 3, 2) of each corner in an image, NaN where a
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
                value = as_array(value, name, str(shape)).astype(np.float64, copy=False)
                if value.shape != shape:
                    raise InputError(f"mesh {name} have shape {value.shape}, expected {shape}, one a vertex")
                object.__setattr__(self, name, value)
        for name, value in self.attributes.items():
            if np.shape(value) != (len(vertices),):
                raise InputError(f"mesh attribute {name!r} has shape {np.shape(value)}, expected {(len(vertices),)}, "
                                 "one a vertex")

    def __repr__(self) -> str:
        return f"Surface({len(self.vertices)} vertices, {len(self.faces)} faces)"


def _checked(vertices: Any, faces: Any) -> tuple[np.ndarray, np.ndarray]:
    vertices, faces = as_array(vertices, "vertices", "(V, 3)"), as_array(faces, "faces", "(F, 3)")
    vertices = np.ascontiguousarray(vertices, np.float64)
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise InputError(f"mesh vertices have shape {vertices.shape}, expected (V, 3)")
    if faces.size == 0:
        faces = faces.reshape(0, 3).astype(np.int32)
    if faces.ndim != 2 or faces.shape[1] != 3:
        raise InputError(f"mesh faces have shape {faces.shape}, expected (F, 3): triangulate the mesh first")
    if faces.dtype.kind not in "iu":
        raise InputError(f"mesh faces have dtype {faces.dtype}, expected integers")
    if len(vertices) == 0 or len(faces) == 0:
        raise InputError(f"the mesh is empty: {len(vertices)} vertices and {len(faces)} faces; " + (
            "a point cloud has to be made a mesh first (Poisson reconstruction, say)" if len(vertices) else
            "of a file that it cannot read Open3D makes such: is the path right?"))
    if not np.isfinite(vertices).all():
        bad = ~np.isfinite(vertices).all(axis=1)
        raise InputError(f"mesh vertex {int(np.argmax(bad))} is not finite ({int(bad.sum())} of {len(vertices)} are "
                         "not): remove them first")
    if max(vertices.max(), -vertices.min()) > _FARTHEST:
        far = np.abs(vertices).max(axis=1)
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
    a, b, c = (np.take(vertices, corner, axis=0) for corner in faces.T)      # a third of the time of vertices[corner]
    b -= a
    c -= a
    (x, y, z), (u, v, w) = b.T, c.T
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=1)


def grid_faces(across: int, down: int) -> np.ndarray:
    """Triangles (F, 3) of a grid of `down` rows of `across` vertices."""
    index = np.arange(across * down).reshape(down, across)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]))
    return np.concatenate([np.stack([a, c, b], axis=1), np.stack([b, c, d], axis=1)])


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Sum of the normals of the triangles around each vertex, as long as twice their area: float64 (V, 3)."""
    across, corners = triangle_normals(vertices, faces), faces.T.astype(np.intp).ravel()
    return np.stack([np.bincount(corners, np.tile(column, 3), len(vertices)) for column in across.T], axis=1)


def with_normals(surface: Surface) -> Surface:
    """The same with unit normals of its vertices, 0 where there is no triangle."""
    normals = vertex_normals(surface.vertices, surface.faces)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(float).tiny)
    return replace(surface, normals=normals)


class Split(Protocol):
    """How the faces of a mesh are split (surface.subdivide.Subdivision), and with them what sits on the mesh."""

    faces: np.ndarray | None       # (F', 3), None where they are the same

    def vertices(self, values: np.ndarray) -> np.ndarray:
        """Values of shape (V, ...) on the new vertices."""

    def corners(self, values: np.ndarray) -> np.ndarray:
        """Values of shape (F, 3, C) on the corners of the new faces."""

    def on_faces(self, values: np.ndarray) -> np.ndarray:
        """Values of shape (F, ...) on the new faces."""


class Unsplit:
    faces: np.ndarray | None = None

    @staticmethod
    def vertices(values: np.ndarray) -> np.ndarray:
        return values

    corners = on_faces = vertices


@dataclass(frozen=True, eq=False)
class Change:
    """What becomes of a mesh: vertices (V', 3), its faces split, and what sits on the vertices (V', ...)."""

    vertices: np.ndarray = field(repr=False)
    split: Split
    quality: np.ndarray | None = field(repr=False)
    attributes: Mapping[str, np.ndarray] = field(repr=False)
    colors: np.ndarray | None = field(repr=False)


@dataclass(frozen=True)
class MeshKind:
    """`to_surface(mesh)`; `from_surface(surface, like)`: as `like` is; `changed(mesh, change)`: a new mesh, all else of
    `mesh` carried along; `sits_on(mesh)`, as kinds.sits_on; `has_quality(mesh)`: one of its own."""

    to_surface: Callable[[Any], Surface]
    from_surface: Callable[[Surface, Any], Mesh]
    changed: Callable[[Any, Change], Mesh]
    sits_on: Callable[[Any], tuple[set[str], bool]]
    has_quality: Callable[[Any], bool] = lambda mesh: False
