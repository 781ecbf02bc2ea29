"""Every kind of mesh (Open3D, pymeshlab, arrays, files) as a Surface, and back; and with other vertices."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from pagas_cl import errors
from pagas_cl.errors import InputError, log
from pagas_cl.scene.mesh import Change, Mesh, MeshKind, Split, Surface, Texture, Unsplit, with_normals
from pagas_cl.scene.meshes.files import read_mesh
from pagas_cl.scene.meshes.meshlab_layer import CONFIDENCE
from pagas_cl.scene.meshes.open3d_meshes import LEGACY, TENSOR
from pagas_cl.scene.meshes.pymeshlab_meshes import PYMESHLAB

_MADE = {"positions", "normals", "deviation", "views"}       # what a refined mesh gets anew on its vertices


def kind_of(mesh: Mesh) -> MeshKind:
    """Of a mesh that is no path; InputError where it is none. Imports neither Open3D nor pymeshlab."""
    if isinstance(mesh, Surface):
        return SURFACE
    module, name = type(mesh).__module__, type(mesh).__name__
    if module.startswith("open3d") and name == "TriangleMesh":
        return TENSOR if ".t." in module or hasattr(mesh, "vertex") else LEGACY
    if module.startswith("pymeshlab") and name in ("Mesh", "MeshSet"):
        return PYMESHLAB
    if isinstance(mesh, (tuple, list)) and len(mesh) == 2:
        return ARRAYS
    cloud = "; a point cloud has to be made a mesh first (Poisson reconstruction, say)" if name == "PointCloud" else ""
    raise InputError(f"mesh is {errors.kind_of(mesh)}, expected an Open3D TriangleMesh (legacy or tensor), a "
                     f"pymeshlab.Mesh, a pair (vertices, faces) or the path of a mesh file{cloud}")


def to_surface(mesh: Mesh) -> Surface:
    """Surface of any Mesh; of a MeshSet the current mesh, layer matrix applied. InputError where it is empty, of an
    unknown kind, cannot be read, or has vertices that are not finite or face indices out of range."""
    return read_mesh(mesh) if isinstance(mesh, (str, Path)) else kind_of(mesh).to_surface(mesh)


def from_surface(surface: Surface, like: Mesh) -> Mesh:
    """`surface` as a new mesh of the kind that `like` is (a path gives the Surface itself).

    pymeshlab keeps colours in 8 bits and makes its own normals.
    """
    return surface if isinstance(like, (str, Path)) else kind_of(like).from_surface(surface, like)


def with_vertices(mesh: Mesh, vertices: np.ndarray, subdivision: Split | None = None,
                  quality: np.ndarray | None = None, attributes: Mapping[str, np.ndarray] = MappingProxyType({}),
                  colors: np.ndarray | None = None) -> Mesh:
    """A new mesh of `mesh`'s kind with `vertices`, its faces split as `subdivision` says, all else carried along.

    `vertices` are (V', 3) float64, world coordinates; `quality` and `attributes` (V',) are for the kinds that have
    such: Surface, Open3D's tensor mesh, pymeshlab. A quality that `mesh` has stays: then `quality` becomes the
    attribute CONFIDENCE. `colors` (V', 3), 0 to 1, replace those of `mesh`.
    """
    kind = kind_of(mesh)
    if quality is not None and kind.has_quality(mesh):
        log.info("the mesh has a vertex quality, which stays: the confidence is the attribute %r", CONFIDENCE)
        attributes, quality = {**attributes, CONFIDENCE: quality}, None
    return kind.changed(mesh, Change(vertices, subdivision or Unsplit(), quality, attributes, colors))


def sits_on(mesh: Mesh) -> tuple[set[str], bool]:
    """What sits on vertices, but for what a refined mesh gets anew, and whether anything sits on faces or corners."""
    of_vertices, of_faces = kind_of(mesh).sits_on(mesh)
    return of_vertices - _MADE, of_faces


def _changed_surface(mesh: Surface, change: Change) -> Surface:
    split, texture = change.split, mesh.texture

    def carried(values: np.ndarray | None) -> Any:
        return None if values is None else split.vertices(values)

    if texture is not None:
        coordinates = None if texture.coordinates is None else split.corners(texture.coordinates)
        texture = Texture(coordinates, split.on_faces(texture.materials), texture.library)
    return with_normals(Surface(
        change.vertices, mesh.faces if split.faces is None else split.faces, None,
        carried(mesh.colors) if change.colors is None else change.colors,
        carried(mesh.quality) if change.quality is None else change.quality,
        {**{name: carried(value) for name, value in mesh.attributes.items()}, **change.attributes}, texture))


def _sits_on_surface(mesh: Surface) -> tuple[set[str], bool]:
    own = {name for name, values in (("colors", mesh.colors), ("quality", mesh.quality)) if values is not None}
    return own | set(mesh.attributes), mesh.texture is not None


SURFACE = MeshKind(to_surface=lambda surface: surface, from_surface=lambda surface, like: surface,
                   changed=_changed_surface, sits_on=_sits_on_surface,
                   has_quality=lambda surface: surface.quality is not None)
ARRAYS = MeshKind(
    to_surface=lambda pair: Surface(*pair),
    from_surface=lambda surface, like: (surface.vertices.copy(), surface.faces.copy()),
    changed=lambda pair, change: (change.vertices, np.array(pair[1]) if change.split.faces is None
                                  else change.split.faces),
    sits_on=lambda pair: (set(), False))
