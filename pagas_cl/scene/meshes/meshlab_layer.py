"""A layer of pymeshlab with all that MeshLab keeps on it, by name: colours, quality, texture coordinates with the
number of their texture, custom attributes.

pymeshlab does not give which texture a face has; the .ply that it writes of the layer has it. Custom attributes are
left out there, and added to the mesh that it makes of such a file.
"""

import os
import re
import shutil
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from pagas_cl.errors import InputError, OutputError, log, need
from pagas_cl.scene.images import open_image
from pagas_cl.scene.meshes import ply
from pagas_cl.scene.meshes.files import check_mesh_file, read_content
from pagas_cl.scene.own_files import TEXT_MARK
from pagas_cl.system.files import translated

CONFIDENCE = "pagas_confidence"     # the attribute next to a vertex quality of the user's own
SCRATCH = "pagasscratch"            # attributes that only moved values into the layer begin so: pymeshlab removes none
_NO_TEXTURE = "dummy.png"           # what pymeshlab takes in place of a texture that it cannot read
_ROOM = 1 << 16                     # bytes that must be free when a mesh is written
_COLORS = ("red", "green", "blue", "alpha")
_CORNERS = "vertex_indices"
# columns of a .ply that pymeshlab reads as something else than a custom attribute
_KNOWN = {"vertex": {"x", "y", "z", "nx", "ny", "nz", "red", "green", "blue", "alpha", "quality", "flags", "radius",
                     "texture_u", "texture_v", "texture_w", "s", "t", "u", "v", "texnum", "diffuse_red",
                     "diffuse_green", "diffuse_blue", "intensity"},
          "face": {"vertex_indices", "vertex_index", "texcoord", "texnumber", "red", "green", "blue", "alpha", "color",
                   "quality", "flags", "nx", "ny", "nz"}}
_MARKED = {".ply": (2, "comment "), ".obj": (0, "# ")}      # after so many lines the mark stands

Columns = dict[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class Layer:
    """Columns of the vertices (V,) or (V, K) and of the faces (F,) or (F, K) by property of a .ply, in its order; the
    custom attributes of MeshLab, of "vertex" and "face"; the header's comments, which name the textures."""

    vertex: Columns = field(repr=False)
    face: Columns = field(repr=False)
    custom: Mapping[str, Columns] = field(repr=False)
    comments: tuple[str, ...] = ()

    def carried(self, vertices: np.ndarray, carry: Any) -> "Layer":
        """The same on other `vertices` (V', 3), faces split as `carry`, a surface.subdivide.Subdivision, says: mean
        values on new vertices, a face's own on its parts."""
        vertex = {name: _mean(name, column, carry) for name, column in self.vertex.items()}
        vertex.update(zip("xyz", np.asarray(vertices, np.float64).T))
        face = {name: carry.on_faces(column) for name, column in self.face.items()}
        face[_CORNERS] = carry.faces
        if "texcoord" in face:
            face["texcoord"] = carry.corners(self.face["texcoord"].reshape(-1, 3, 2)).reshape(-1, 6)
        custom = {"vertex": {name: carry.vertices(column) for name, column in self.custom["vertex"].items()},
                  "face": {name: carry.on_faces(column) for name, column in self.custom["face"].items()}}
        return Layer(vertex, face, custom, self.comments)


def _mean(name: str, column: np.ndarray, carry: Any) -> np.ndarray:
    mean: np.ndarray = carry.vertices(column / 255 if name in _COLORS else column)
    return np.rint(np.clip(mean, 0, 1) * 255).astype(np.uint8) if name in _COLORS else mean


def custom_keys(meshes: Any) -> list[str]:
    """How save_current_mesh calls the custom attributes of the current layer: "__ca_vs__age", with "v" or "f" for
    vertices or faces, "s" or "p" for scalars or points, and the name in small letters."""
    return [key for key in meshes.filter_parameter_values("ply")
            if key.startswith("__ca_") and not key[len("__ca_vs__"):].startswith(SCRATCH)]


def read_custom(meshes: Any, spellings: Collection[str] = ()) -> tuple[dict[str, Columns], list[str]]:
    """The custom attributes of the current layer of a pymeshlab.MeshSet, for "vertex" and "face"; and the names, in
    small letters, of those that cannot be read: pymeshlab takes the name as it was given, but does not list it so.
    `spellings` are tried. (A .ply with the attributes would have the names; writing one ends the process where the
    layer is one that add_mesh has copied.)"""
    pymeshlab = need("pymeshlab", "meshlab", "reading a pymeshlab mesh")
    found: dict[str, Columns] = {"vertex": {}, "face": {}}
    unread = []
    for key in custom_keys(meshes):
        name, of = key[len("__ca_vs__"):], "vertex" if key[len("__ca_")] == "v" else "face"
        what = "scalar_attribute_array" if key[len("__ca_v")] == "s" else "point_attribute_matrix"
        read = getattr(meshes.current_mesh(), f"{of}_custom_{what}")
        for spelled in (name, *(word for word in spellings if re.sub(r"\W", "_", word.lower()) == name)):
            try:
                found[of][spelled] = read(spelled)
                break
            except (pymeshlab.PyMeshLabException, RuntimeError):
                continue
        else:
            unread.append(name)
    return found, unread


def write_mesh_file(meshes: Any, path: Path, **options: Any) -> None:
    """Let pymeshlab write its current layer; OSError where the disk does not take all of it, which pymeshlab does not
    say of every kind of file, or any other reason."""
    pymeshlab, reason = need("pymeshlab", "meshlab", "writing a mesh by pymeshlab"), ""
    try:
        meshes.save_current_mesh(str(path), **options)
    except (pymeshlab.PyMeshLabException, RuntimeError, IndexError) as error:
        reason = " ".join(str(error).split())[:200]
    with open(path, "ab") as file:      # is there room for more?
        end = file.seek(0, os.SEEK_END)
        file.write(bytes(_ROOM))
        file.flush()
        os.fsync(file.fileno())
        file.truncate(end)
    if reason or not end:
        raise OutputError(f"pymeshlab cannot write {str(path.name)!r}: {reason or 'it wrote nothing'}")


def read_layer(meshes: Any, folder: Path, spellings: Collection[str] = ()) -> Layer:
    """The current layer of a pymeshlab.MeshSet, but for those custom attributes that read_custom cannot read; `folder`
    gets its textures. InputError where pymeshlab does not write it as it is."""
    mesh, path = meshes.current_mesh(), folder / "layer.ply"
    write_mesh_file(meshes, path)
    layer = read_columns(path)
    if layer is None or (len(layer.vertex["x"]), *layer.face[_CORNERS].shape) != (
            mesh.vertex_number(), mesh.face_number(), 3):
        raise InputError("this pymeshlab does not write a layer's triangles as they are; use output='displace'")
    return replace(layer, custom=read_custom(meshes, spellings)[0])


def has_quality(mesh: Any) -> bool:
    """Whether a pymeshlab.Mesh has a vertex quality: not where all of it is the 0 that pymeshlab begins with."""
    return bool(mesh.has_vertex_scalar() and mesh.vertex_scalar_array().any())


def add_custom(mesh: Any, of: str, columns: Mapping[str, np.ndarray]) -> None:
    """Give the "vertex" or "face" elements of a pymeshlab.Mesh custom attributes, (N,) scalars or (N, 3) points."""
    for name, column in columns.items():
        kind = "scalar" if column.ndim == 1 else "point"
        add = getattr(mesh, f"add_{of}_custom_{kind}_attribute")
        add(np.ascontiguousarray(column, np.float64), name)


def load_layer(meshes: Any, layer: Layer, folder: Path) -> None:
    """`layer` as a new current layer; its textures lie in `folder`."""
    path = folder / "carried.ply"
    ply.write_elements(path, layer.comments, {"vertex": layer.vertex, "face": layer.face})
    meshes.load_new_mesh(str(path))
    mesh = meshes.current_mesh()
    places = np.stack([layer.vertex[axis] for axis in "xyz"], axis=1)
    if not (np.array_equal(mesh.vertex_matrix(), places)
            and np.array_equal(mesh.face_matrix(), layer.face[_CORNERS])):
        raise InputError("this pymeshlab does not read the .ply of a layer exactly; use output='displace'")
    for of, columns in layer.custom.items():
        add_custom(mesh, of, columns)


def read_columns(path: Path) -> Layer | None:
    """All columns of a binary .ply of triangles in the machine's byte order, no custom attributes; None of another one,
    or one whose lists differ in length. InputError where it is damaged."""
    with translated(f"mesh {str(path)!r} cannot be read: "):
        header, elements = ply.read_elements(path)
    if header.form == "ascii" or not {"vertex", "face"} <= elements.keys():
        return None
    of = elements["vertex"], elements["face"]
    if any((lengths != lengths[:1]).any() for columns in of for lengths in columns.lengths.values()):
        return None
    vertex, face = ({name: column.astype(column.dtype.newbyteorder("=")) for name, column in columns.values.items()}
                    for columns in of)
    return Layer(vertex, face, {"vertex": {}, "face": {}}, tuple(header.comments)) if _CORNERS in face else None


def load_file(meshes: Any, path: Path, outside: bool, label: str = "", matrix: np.ndarray | None = None) -> list[str]:
    """A mesh file as a new layer, which becomes the current one; its matrix keeps all its digits. Gives the names of
    its custom attributes. InputError where it is damaged, or names files out of its folder without `outside`."""
    pymeshlab = need("pymeshlab", "meshlab", "reading a mesh by pymeshlab")
    check_mesh_file(path, outside=outside)
    try:
        meshes.load_new_mesh(str(Path(path).absolute()))
    except (pymeshlab.PyMeshLabException, RuntimeError) as error:
        raise InputError(f"mesh {str(path)!r} cannot be read: {' '.join(str(error).split())[:200]}") from error
    if _NO_TEXTURE in meshes.current_mesh().textures():
        log.warning("not kept: textures of %s that are missing or that pymeshlab does not read (it takes %r): write "
                    "them as .png, or use 'pagas-cl refine', which keeps them", path, _NO_TEXTURE)
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
            add_custom(mesh, "vertex", {
                f"{SCRATCH}quality": custom["confidence"] if content.quality is None else content.quality})
            meshes.compute_scalar_by_function_per_vertex(q=f"{SCRATCH}quality", onselected=False)
        add_custom(mesh, of, custom)
        added += custom
    lost = [what for what in content.lost if what.split("'")[1:2] not in [[name] for name in {*added, *_KNOWN["face"]}]]
    if lost:
        log.warning("not kept: of %s, pymeshlab does not read: %s", path, ", ".join(lost))
    return added


def write_file(meshes: Any, path: Path, folder: Path) -> None:
    """The current layer, with the layer's own coordinates, its custom attributes where the file is a .ply, and the mark
    of pagas_cl where the kind has a place for it. OSError where the disk does not take it.

    `folder` is where it goes: textures that lie there already, with the same pixels, stay as they are."""
    kind = path.suffix.lower()
    write_mesh_file(meshes, path, **(dict.fromkeys(custom_keys(meshes), True) if kind == ".ply" else {}))
    for name in meshes.current_mesh().textures():
        if same_pixels(path.parent / name, folder / name):
            (path.parent / name).unlink()      # which pymeshlab has encoded anew
    if kind == ".stl":
        with open(path, "r+b") as file:
            file.write(TEXT_MARK.encode().ljust(80))
    elif kind == ".off":
        with open(path, "ab") as file:      # as meshes.off does
            file.write(f"# {TEXT_MARK}\n".encode())
    elif kind in _MARKED:
        lines, start = _MARKED[kind]
        marked = path.with_name(f"{path.name}.marked")
        with open(path, "rb") as file, open(marked, "wb") as new:
            new.writelines(file.readline() for _ in range(lines))
            new.write(f"{start}{TEXT_MARK}\n".encode())
            shutil.copyfileobj(file, new)
        os.replace(marked, path)


def same_pixels(one: Path, other: Path) -> bool:
    """Whether two files are images that look alike."""
    try:
        with open_image(one) as a, open_image(other) as b:
            return np.array_equal(np.asarray(a.convert("RGBA")), np.asarray(b.convert("RGBA")))
    except (InputError, OSError, ValueError, SyntaxError):      # one of them is no image
        return False
