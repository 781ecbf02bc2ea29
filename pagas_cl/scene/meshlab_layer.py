"""A layer of pymeshlab with all that MeshLab keeps on it, by name: colours, quality, texture coordinates with the number
of their texture, custom attributes.

pymeshlab tells neither which custom attributes a mesh has nor which texture a face has; the .ply that MeshLab writes of
the layer does. It reads such a file without its custom attributes: those are added to the mesh that it makes of it.
"""

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from pagas_cl.errors import InputError, need
from pagas_cl.scene.files import opened, translated
from pagas_cl.scene.ply import CORNERS, HEADER, TYPES, header_of

CONFIDENCE = "pagas_confidence"     # the attribute beside a vertex quality of the user's own
SCRATCH = "pagasscratch"            # attributes that only moved values into the layer begin so: pymeshlab removes none
_NAMES = {TYPES[name]: name for name in ("uchar", "char", "short", "ushort", "int", "uint", "float", "double")}
_COLORS = ("red", "green", "blue", "alpha")
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}

Columns = dict[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class Layer:
    """Columns of the vertices (V,) or (V, K) and of the faces (F,) or (F, K) by property of a .ply, in its order; how
    many of the last ones are custom attributes of MeshLab; the header's comments, which name the textures."""

    vertex: Columns = field(repr=False)
    face: Columns = field(repr=False)
    customs: tuple[int, int]
    comments: tuple[str, ...] = ()

    def custom(self, of: str) -> Columns:
        """The custom attributes of "vertex" or "face"."""
        columns, count = (self.vertex, self.customs[0]) if of == "vertex" else (self.face, self.customs[1])
        return dict(list(columns.items())[len(columns) - count:])

    def plain(self, of: str) -> Columns:
        """The others."""
        custom = self.custom(of)
        return {name: column for name, column in (self.vertex if of == "vertex" else self.face).items()
                if name not in custom}

    def carried(self, vertices: np.ndarray, carry: Any) -> "Layer":
        """The same on other `vertices` (V', 3), faces split as `carry`, a surface.subdivide.Subdivision, says: mean
        values on new vertices, a face's own on its parts."""
        vertex = {name: _mean(name, column, carry) for name, column in self.vertex.items()}
        vertex.update(zip("xyz", np.asarray(vertices, np.float64).T))
        face = {name: carry.on_faces(column) for name, column in self.face.items() if name != "texcoord"}
        if "texcoord" in self.face:
            face["texcoord"] = carry.corners(self.face["texcoord"].reshape(-1, 3, 2)).reshape(-1, 6)
        face = {name: carry.faces if name in CORNERS else face[name] for name in self.face}
        return replace(self, vertex=vertex, face=face)


def _mean(name: str, column: np.ndarray, carry: Any) -> np.ndarray:
    if name not in _COLORS:
        return carry.vertices(column)
    return np.rint(np.clip(carry.vertices(column / 255), 0, 1) * 255).astype(np.uint8)


def custom_keys(meshes: Any) -> dict[str, bool]:
    """What save_current_mesh takes to write the custom attributes of the current layer into a .ply."""
    return {key: True for key in meshes.filter_parameter_values("ply")
            if key.startswith("__ca_") and not key[len("__ca_vs__"):].startswith(SCRATCH)}


def read_layer(meshes: Any, folder: Path) -> Layer:
    """The current layer of a pymeshlab.MeshSet; `folder` gets its textures. InputError where pymeshlab does not write
    it as it is."""
    keys, mesh = custom_keys(meshes), meshes.current_mesh()
    path = folder / "layer.ply"
    meshes.save_current_mesh(str(path), **keys)
    layer = read_columns(path)
    whole = layer is not None and (len(layer.vertex["x"]), *layer.face["vertex_indices"].shape) == (
        mesh.vertex_number(), mesh.face_number(), 3)
    if layer is None or not whole:
        raise InputError("this pymeshlab does not write a layer's triangles as they are; use output='displace'")
    count = [sum(key.startswith(f"__ca_{of}") for key in keys) for of in "vf"]
    return replace(layer, customs=(count[0], count[1]))


def read_custom(mesh: Any) -> Layer:
    """The same of a pymeshlab.Mesh that may be in no MeshSet."""
    meshes = need("pymeshlab", "meshlab", "reading a pymeshlab mesh").MeshSet()
    meshes.add_mesh(mesh)
    with tempfile.TemporaryDirectory() as folder:
        return read_layer(meshes, Path(folder))


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
    write_columns(path, replace(layer, vertex=layer.plain("vertex"), face=layer.plain("face")))
    meshes.load_new_mesh(str(path))
    mesh = meshes.current_mesh()
    places = np.stack([layer.vertex[axis] for axis in "xyz"], axis=1)
    if not (np.array_equal(mesh.vertex_matrix(), places)
            and np.array_equal(mesh.face_matrix(), layer.face["vertex_indices"])):
        raise InputError("this pymeshlab does not read the .ply of a layer exactly; use output='displace'")
    add_custom(mesh, "vertex", layer.custom("vertex"))
    add_custom(mesh, "face", layer.custom("face"))


def read_columns(path: Path) -> Layer | None:
    """All columns of a binary .ply of triangles, none of them called custom; None of another one, or one whose lists
    differ in length. InputError where it is damaged."""
    with opened(path, 1 << 40) as file, translated(f"mesh {str(path)!r} cannot be read: "):
        head = file.read(HEADER)
        kind, elements, start = header_of(head)
        if kind not in _ORDERS or not start or [name for name, _, _ in elements[:2]] != ["vertex", "face"]:
            return None
        file.seek(start)
        tables = []
        for _, count, properties in elements[:2]:
            here = file.tell()
            counts = _list_lengths(file.read(1 << 12), properties, _ORDERS[kind])
            file.seek(here)
            table = np.fromfile(file, _layout(properties, counts, _ORDERS[kind]), count)
            if len(table) < count or any((table[f"#{name}"] != length).any() for name, length in counts.items()):
                return None
            tables.append({name: table[name].astype(table.dtype[name].base.newbyteorder("="))
                           for name in table.dtype.names or () if not name.startswith("#")})
    comments = [line for line in head[:start].decode("ascii", "replace").splitlines() if line.startswith("comment ")]
    return Layer(tables[0], tables[1], (0, 0), tuple(comments))


def _list_lengths(first: bytes, properties: list[list[str]], order: str) -> dict[str, int]:
    """Lengths of the lists of the first of some elements, which begins with the bytes `first`."""
    counts: dict[str, int] = {}
    for place, words in enumerate(properties):
        if words[0] == "list":
            begin = _layout(properties[:place], counts, order).itemsize
            counts[" ".join(words[3:])] = int(np.frombuffer(first, order + TYPES[words[1]], 1, begin)[0])
    return counts


def _layout(properties: list[list[str]], counts: Mapping[str, int], order: str) -> np.dtype:
    fields: list[tuple[Any, ...]] = []
    for words in properties:      # MeshLab writes names with spaces, too
        if words[0] == "list":
            name = " ".join(words[3:])
            fields += [(f"#{name}", order + TYPES[words[1]]), (name, order + TYPES[words[2]], (counts[name],))]
        else:
            fields.append((" ".join(words[1:]), order + TYPES[words[0]]))
    return np.dtype(fields)


def write_columns(path: Path, layer: Layer) -> None:
    """A binary .ply of the columns."""
    header, tables = ["ply", "format binary_little_endian 1.0", *layer.comments], []
    for element, columns in (("vertex", layer.vertex), ("face", layer.face)):
        header.append(f"element {element} {len(next(iter(columns.values())))}")
        fields: list[tuple[Any, ...]] = []
        for name, column in columns.items():
            kind = column.dtype.str[1:]
            header.append(f"property {'list uchar ' if column.ndim == 2 else ''}{_NAMES[kind]} {name}")
            fields += [(f"#{name}", "u1"), (name, f"<{kind}", column.shape[1:])] if column.ndim == 2 else [
                (name, f"<{kind}")]
        table = np.empty(len(next(iter(columns.values()))), np.dtype(fields))
        for name, column in columns.items():
            table[name] = column
            if column.ndim == 2:
                table[f"#{name}"] = column.shape[1]
        tables.append(table)
    with open(path, "wb") as file:
        file.write(("\n".join([*header, "end_header"]) + "\n").encode("ascii", "replace"))
        for table in tables:
            table.tofile(file)
