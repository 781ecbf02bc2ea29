"""Binary .ply files of triangles, by NumPy alone: all that a Surface has, further numbers of vertices among it."""

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
        layouts = _layouts(file)
        if not layouts:
            return None
        (numbers, count), (corners, faces) = layouts
        vertices, triangles = np.fromfile(file, numbers, count), np.fromfile(file, corners, faces)
        if not faces or len(triangles) < faces or (triangles["count"] != 3).any():
            return None
    return {**_of_vertices(vertices), "faces": triangles["corners"]}


def keeps_numbers(path: Path) -> bool:
    """Whether read_ply keeps all numbers of its vertices, if its faces are triangles."""
    with opened(path, 1 << 40) as file, translated(f"mesh {str(path)!r} cannot be read: "):
        return bool(_layouts(file))


def header_of(head: bytes) -> tuple[str, list[tuple[str, int, list[list[str]]]], int]:
    """What the first bytes of a .ply say: its format; of each element the name, the number and the words of its
    properties; and where what they describe begins, 0 where the header does not end."""
    header, end, rest = head.partition(b"end_header")
    lines = [line.split() for line in header.decode("ascii", "replace").splitlines()]
    kind = next((words[1] for words in lines if words[:1] == ["format"] and len(words) > 1), "")
    elements: list[tuple[str, int, list[list[str]]]] = []
    for words in lines:
        if words[:1] == ["element"] and len(words) > 2 and words[2].isdecimal():
            elements.append((words[1], int(words[2][:20]), []))
        elif words[:1] == ["property"] and elements:
            elements[-1][2].append(words[1:])
    return kind, elements, len(header) + len(end) + (2 if rest[:2] == b"\r\n" else 1) if end else 0


def _layouts(file: BinaryIO) -> list[tuple[np.dtype, int]]:
    """Layout and number of vertices and of faces, taken for triangles, which the file stands before then; nothing where
    it is none of ours."""
    kind, elements, start = header_of(file.read(HEADER))
    if any(name == "vertex" and not {*_PLACES} <= {words[-1] for words in properties if words}
           for name, _, properties in elements):
        raise InputError(f"mesh {file.name!r}: its vertices have no x, y and z")      # others end the process on it
    order = _ORDERS.get(kind)
    if not start or order is None or [name for name, _, _ in elements[:2]] != ["vertex", "face"]:
        return []
    layouts = []
    for _, count, properties in elements:
        fields: list[tuple[Any, ...]] = []
        for words in properties:
            if len(words) == 2 and words[0] in TYPES:
                fields.append((words[1], order + TYPES[words[0]]))
            elif words[:1] == ["list"] and len(words) == 4 and words[3] in CORNERS and {*words[1:3]} <= TYPES.keys():
                fields += [("count", order + TYPES[words[1]]), ("corners", order + TYPES[words[2]], 3)]
            else:
                return []
        layouts.append((np.dtype(fields), count))
    file.seek(start)
    return layouts[:2] if "corners" in (layouts[1][0].names or ()) else []


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
