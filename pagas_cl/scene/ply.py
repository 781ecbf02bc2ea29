"""Binary .ply files of triangles, by NumPy alone: all that a Surface has, further numbers of vertices among it."""

import re
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from pagas_cl.errors import InputError
from pagas_cl.scene.files import opened, translated
from pagas_cl.scene.mesh import Surface

HEADER = 1 << 16         # bytes of a file in which its header must end
TYPES = {"char": "i1", "uchar": "u1", "int8": "i1", "uint8": "u1", "short": "i2", "ushort": "u2", "int16": "i2",
         "uint16": "u2", "int": "i4", "uint": "u4", "int32": "i4", "uint32": "u4", "float": "f4", "float32": "f4",
         "double": "f8", "float64": "f8"}
CORNERS = ("vertex_indices", "vertex_index")
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
_PLACES, _NORMALS, _COLORS = ("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue")


def read_ply(path: Path) -> dict[str, Any] | None:
    """Fields of a Surface from a binary .ply whose faces are triangles; None of another one. InputError where it is
    damaged."""
    with opened(path, 1 << 40) as file, translated(f"mesh {str(path)!r} cannot be read: "):
        elements = _elements(file)
        if not elements:
            return None
        (numbers, count), (corners, faces) = elements
        vertices, triangles = np.fromfile(file, numbers, count), np.fromfile(file, corners, faces)
        if not faces or len(triangles) < faces or (triangles["count"] != 3).any():
            return None
    return {**_of_vertices(vertices), "faces": triangles["corners"]}


def keeps_numbers(path: Path) -> bool:
    """Whether read_ply keeps all numbers of its vertices, if its faces are triangles."""
    with opened(path, 1 << 40) as file:
        return bool(_elements(file))


def _elements(file: BinaryIO) -> list[tuple[np.dtype, int]]:
    """Layout and number of vertices and of faces, taken for triangles, which the file stands before then; nothing where
    it is none of ours."""
    header, end, rest = file.read(HEADER).partition(b"end_header")
    if b"element vertex" in header and not all(re.search(rb"property \w+ %c\s" % axis, header) for axis in b"xyz"):
        raise InputError(f"mesh {file.name!r}: its vertices have no x, y and z")      # others end the process on it
    lines = [line.split() for line in header.decode("ascii", "replace").splitlines()]
    order = next((_ORDERS.get(words[1]) for words in lines if words[:1] == ["format"] and len(words) > 1), None)
    if not end or order is None:
        return []
    elements: list[tuple[str, int, list[tuple[Any, ...]]]] = []
    for words in lines:
        if words[:1] == ["element"] and len(words) == 3 and words[2].isdecimal():
            elements.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"] and elements and words[1] in TYPES and len(words) == 3:
            elements[-1][2].append((words[2], order + TYPES[words[1]]))
        elif words[:2] == ["property", "list"] and elements and len(words) == 5 and words[4] in CORNERS:
            elements[-1][2].extend([("count", order + TYPES[words[2]]), ("corners", order + TYPES[words[3]], 3)])
        elif words[:1] == ["property"]:
            return []
    file.seek(len(header) + len(end) + (2 if rest[:2] == b"\r\n" else 1))
    layouts = [(np.dtype(fields), count) for _, count, fields in elements[:2]]
    ours = [name for name, _, _ in elements[:2]] == ["vertex", "face"]
    has = [{*(layout.names or ())} for layout, _ in layouts]
    return layouts if ours and {*_PLACES} <= has[0] and "corners" in has[1] else []


def _of_vertices(vertices: np.ndarray) -> dict[str, Any]:
    names = vertices.dtype.names or ()

    def columns(wanted: tuple[str, ...]) -> np.ndarray | None:
        """(V, 3), whole numbers as shares of their largest one."""
        if not set(wanted) <= set(names):
            return None
        most = np.iinfo(vertices[wanted[0]].dtype).max if vertices[wanted[0]].dtype.kind in "iu" else 1
        return np.stack([vertices[name] for name in wanted], axis=1).astype(np.float64) / most

    known = {*_PLACES, *_NORMALS, *_COLORS, "quality"}
    return {"vertices": np.stack([vertices[name] for name in _PLACES], axis=1), "normals": columns(_NORMALS),
            "colors": columns(_COLORS), "quality": vertices["quality"] if "quality" in names else None,
            "attributes": {name: vertices[name].astype(np.float64) for name in names if name not in known}}


def write_ply(path: Path, surface: Surface) -> None:
    """Vertices as double, normals, quality and attributes as float, colours as 8 bit."""
    columns: list[tuple[str, str, str, np.ndarray]]  # name, dtype, type in the header, values
    columns = [(axis, "<f8", "double", surface.vertices[:, i]) for i, axis in enumerate(_PLACES)]
    if surface.normals is not None:
        columns += [(name, "<f4", "float", surface.normals[:, i]) for i, name in enumerate(_NORMALS)]
    if surface.colors is not None:
        rgb = np.rint(np.clip(surface.colors, 0, 1) * 255).astype(np.uint8)
        columns += [(name, "u1", "uchar", rgb[:, i]) for i, name in enumerate(_COLORS)]
    if surface.quality is not None:
        columns.append(("quality", "<f4", "float", surface.quality))
    columns += [(name, "<f4", "float", value) for name, value in surface.attributes.items()]
    vertices = np.empty(len(surface.vertices), np.dtype([(name, kind) for name, kind, _, _ in columns]))
    for name, _, _, values in columns:
        vertices[name] = values
    faces = np.empty(len(surface.faces), np.dtype([("count", "u1"), ("face", "<i4", 3)]))
    faces["count"], faces["face"] = 3, surface.faces
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}",
              *(f"property {ply_type} {name}" for name, _, ply_type, _ in columns), f"element face {len(faces)}",
              "property list uchar int vertex_indices", "end_header"]
    with open(path, "wb") as file:
        file.write(("\n".join(header) + "\n").encode("ascii"))
        vertices.tofile(file)
        faces.tofile(file)
