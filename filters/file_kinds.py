"""What a kind of mesh file keeps of a layer: found by writing a small mesh by pymeshlab and reading it back."""

import tempfile
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pagas_cl.errors import InputError, log, need
from pagas_cl.scene.meshes.meshlab_layer import has_quality, read_custom

_FAR = (5e5, 5.4e6, 100.0)      # where map coordinates are
_LEAST = 1e-6                   # of a mesh's size: coordinates that are written less exactly destroy it


@dataclass(frozen=True)
class FileKind:
    """`error`: of a written coordinate, as a share of the largest one; `lost`: what of a mesh's contents does not come
    back; NaN and all of it where pymeshlab does not read such files."""

    suffix: str
    error: float
    lost: Collection[str]


def file_kind(path: Path) -> FileKind:
    """The kind of the output `path`; InputError where pymeshlab writes none such."""
    pymeshlab = need("pymeshlab", "meshlab", "running a filter script")
    places, kind = np.array([[0.123456, 0.654321, 0.1], [3.3, 0.1, 0.2], [0.7, 2.9, 1.3]]) + _FAR, path.suffix.lower()
    try:
        _read_back(pymeshlab, pymeshlab.Mesh(places, [[0, 1, 2]]), kind, read=False)
    except (pymeshlab.PyMeshLabException, RuntimeError) as error:
        raise InputError(f"--output {str(path)!r}: pymeshlab writes no {path.suffix!r} files, expected .ply, .obj, "
                         ".stl, .off, ... or .mlp") from error
    colors = np.eye(4)[[0, 1, 2]] + np.eye(4)[3]
    given = pymeshlab.Mesh(places, [[0, 1, 2]], v_color_matrix=colors, f_color_matrix=colors[:1],
                           v_scalar_array=np.arange(1.0, 4), f_scalar_array=np.ones(1),
                           w_tex_coords_matrix=places[:, :2] % 1)
    try:
        meshes = _read_back(pymeshlab, given, kind)      # held: its meshes end with it
    except (pymeshlab.PyMeshLabException, RuntimeError, IndexError):
        return FileKind(kind, float("nan"), contents_of(given))
    back = meshes.current_mesh()
    error = np.abs(np.sort(back.transformed_vertex_matrix(), axis=0) - np.sort(places, axis=0)).max() / max(_FAR)
    return FileKind(kind, error, contents_of(given) - contents_of(back))


def _read_back(pymeshlab: Any, mesh: Any, kind: str, read: bool = True) -> Any:
    """A MeshSet whose current mesh is `mesh` from a file of the kind, unless it is only to be written."""
    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(mesh)
    with tempfile.TemporaryDirectory() as scratch:
        meshes.save_current_mesh(str(Path(scratch) / f"a{kind}"))
        if read:
            meshes.load_new_mesh(str(Path(scratch) / f"a{kind}"))
    return meshes


def contents_of(mesh: Any) -> set[str]:
    """In words, what a pymeshlab.Mesh has besides triangles."""
    has = {"vertex colours": mesh.has_vertex_color(), "vertex quality": has_quality(mesh),
           "face colours": mesh.has_face_color(),
           "face quality": mesh.has_face_scalar() and mesh.face_scalar_array().any(),
           "texture coordinates": mesh.has_wedge_tex_coord() or mesh.has_vertex_tex_coord()}
    return {name for name, there in has.items() if there}


def check_output(meshes: Any, path: Path, kind: FileKind, names: Collection[str], refines: bool) -> None:
    """Before the work: log what of the current layer, and of the confidence where our step `refines` it, the file
    `path` will not have; InputError where its coordinates would be destroyed. `names` as in read_custom."""
    mesh = meshes.current_mesh()
    places = mesh.vertex_matrix()
    size = np.ptp(places, axis=0).max()
    if kind.error * np.abs(places).max() > _LEAST * size:
        raise InputError(f"--output {str(path)!r}: {kind.suffix} files have too few digits for coordinates of up to "
                         f"{np.abs(places).max():.7g} where the mesh is {size:.3g} wide; write a .ply, or move the "
                         "mesh to the origin first")
    lost = sorted((contents_of(mesh) | ({"vertex quality"} if refines else set())) & set(kind.lost))
    if kind.suffix != ".ply":
        custom, unread = read_custom(meshes, names)
        lost += [f"custom attribute {name!r}" for name in (*custom["vertex"], *custom["face"], *unread)]
    if lost:
        log.warning("%s will not have of the layer %r: %s (a .ply has)", path, mesh.label(), ", ".join(lost))
