"""What a kind of mesh that users have has to say: how it becomes a Surface, is made of one, and gets other vertices."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from pagas_cl.scene.mesh import Mesh, Surface


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
