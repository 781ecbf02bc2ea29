"""Mesh files by pymeshlab, with the custom attributes and the vertex quality that it neither reads nor writes alone."""

import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pagas_cl.errors import InputError, log, need
from pagas_cl.scene.meshes.content import MARK
from pagas_cl.scene.meshes.files import check_mesh_file, read_content
from pagas_cl.scene.meshes.meshlab_layer import SCRATCH, add_custom, custom_keys, read_columns, write_mesh_file

# columns of a .ply that pymeshlab reads as something else than a custom attribute
_KNOWN = {"vertex": {"x", "y", "z", "nx", "ny", "nz", "red", "green", "blue", "alpha", "quality", "flags", "radius",
                     "texture_u", "texture_v", "texture_w", "s", "t", "u", "v", "texnum", "diffuse_red",
                     "diffuse_green", "diffuse_blue", "intensity"},
          "face": {"vertex_indices", "vertex_index", "texcoord", "texnumber", "red", "green", "blue", "alpha", "color",
                   "quality", "flags", "nx", "ny", "nz"}}
_MARKED = {".ply": (2, "comment "), ".obj": (0, "# "), ".off": (1, "# ")}      # after so many lines the mark stands


def load_file(meshes: Any, path: Path, outside: bool, label: str = "", matrix: np.ndarray | None = None) -> list[str]:
    """A mesh file as a new layer, which becomes the current one; its matrix keeps all its digits. Gives the names of
    its custom attributes. InputError where it is damaged, or names files out of its folder without `outside`."""
    pymeshlab = need("pymeshlab", "meshlab", "reading a mesh by pymeshlab")
    check_mesh_file(path, outside=outside)
    try:
        meshes.load_new_mesh(str(Path(path).absolute()))
    except (pymeshlab.PyMeshLabException, RuntimeError) as error:
        raise InputError(f"mesh {str(path)!r} cannot be read: {' '.join(str(error).split())[:200]}") from error
    names = _add_columns(meshes, path) if path.suffix.lower() == ".ply" else []
    if label:
        meshes.current_mesh().set_label(label)
    if matrix is not None and not np.array_equal(matrix, np.eye(4)):
        meshes.set_matrix(transformmatrix=np.asarray(matrix, np.float64), freeze=False)
    meshes.clear_filter_script()  # loading is no step of the script
    return names


def _add_columns(meshes: Any, path: Path) -> list[str]:
    """What a .ply has of further numbers of vertices and faces, as custom attributes; their names."""
    content, columns, mesh = read_content(path), read_columns(path), meshes.current_mesh()
    found: dict[str, Mapping[str, np.ndarray]] = {
        "vertex": content.attributes, "face": {} if columns is None else columns.face}
    if columns is not None:      # points, which content has not
        found["vertex"] = {**{name: c for name, c in columns.vertex.items() if c.ndim == 2}, **content.attributes}
    added: list[str] = []
    for of, count in (("vertex", mesh.vertex_number()), ("face", mesh.face_number())):
        custom = {name: column for name, column in found[of].items()
                  if name not in _KNOWN[of] and len(column) == count and column.shape[1:] in ((), (3,))}
        if of == "vertex" and "confidence" in custom:      # pymeshlab takes its float32 for float64
            _set_quality(meshes, custom["confidence"] if content.quality is None else content.quality)
        add_custom(mesh, of, custom)
        added += custom
    lost = [what for what in content.lost if what.split("'")[1:2] not in [[name] for name in {*added, *_KNOWN["face"]}]]
    if lost:
        log.warning("not kept: of %s, pymeshlab does not read: %s", path, ", ".join(lost))
    return added


def _set_quality(meshes: Any, quality: np.ndarray) -> None:
    add_custom(meshes.current_mesh(), "vertex", {f"{SCRATCH}quality": quality})
    meshes.compute_scalar_by_function_per_vertex(q=f"{SCRATCH}quality", onselected=False)


def write_file(meshes: Any, path: Path) -> None:
    """The current layer, with the layer's own coordinates, its custom attributes where the file is a .ply, and the mark
    of pagas_cl where the kind has a place for it. OSError where the disk does not take it."""
    kind = path.suffix.lower()
    write_mesh_file(meshes, path, **(dict.fromkeys(custom_keys(meshes), True) if kind == ".ply" else {}))
    if kind == ".stl":
        with open(path, "r+b") as file:
            file.write(MARK.encode().ljust(80))
    elif kind in _MARKED:
        lines, start = _MARKED[kind]
        marked = path.with_name(f"{path.name}.marked")
        with open(path, "rb") as file, open(marked, "wb") as new:
            new.writelines(file.readline() for _ in range(lines))
            new.write(f"{start}{MARK}\n".encode())
            shutil.copyfileobj(file, new)
        os.replace(marked, path)
