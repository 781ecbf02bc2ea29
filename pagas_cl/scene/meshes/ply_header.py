"""The header of .ply files: their format, elements and columns."""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pagas_cl.errors import InputError
from pagas_cl.scene.meshes.content import MARK

HEADER = 1 << 16         # bytes of a file in which its header must end
_TYPES = {"char": "i1", "uchar": "u1", "int8": "i1", "uint8": "u1", "short": "i2", "ushort": "u2", "int16": "i2",
          "uint16": "u2", "int": "i4", "uint": "u4", "int32": "i4", "uint32": "u4", "float": "f4", "float32": "f4",
          "double": "f8", "float64": "f8"}
TYPE_NAMES = {kind: name for name, kind in reversed(_TYPES.items())}     # the short names, which all programs read
CORNERS = ("vertex_indices", "vertex_index")
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


class Property(NamedTuple):
    """A column: `kind` of its values as the header says, `stored` as they are read (text: as float64); `length` is how
    the number of values of a list is stored, None of what is no list."""

    name: str
    kind: np.dtype
    stored: np.dtype
    length: np.dtype | None

    @property
    def least(self) -> int:
        """Fewest bytes of a row."""
        corners = 3 * self.stored.itemsize if self.name in CORNERS else 0
        return self.stored.itemsize if self.length is None else self.length.itemsize + corners


@dataclass(frozen=True)
class Header:
    form: str                                           # one of _ORDERS
    elements: list[tuple[str, int, list[Property]]]    # name, number of rows, columns
    comments: list[str]
    start: int                                          # byte at which the first row begins


def header_of(head: bytes, path: Path) -> Header:
    """InputError where it does not end, or says what no .ply file says."""
    lines: list[str] = []
    start, form = 0, ""
    elements: list[tuple[str, int, list[Property]]] = []
    comments = []
    while not lines or lines[-1] != "end_header":
        end = head.find(b"\n", start)
        if end < 0:
            raise InputError(f"mesh {str(path)!r} is no .ply file, or its header has no end within {HEADER} bytes: is "
                             "the file damaged?")
        line = head[start:end].decode("utf-8", "surrogateescape").strip()
        start = end + 1
        lines.append(line)
        fields = line.split()
        if fields[:1] == ["format"] and len(fields) > 1:
            form = fields[1]
        elif fields[:1] == ["comment"]:
            comments.append(line.removeprefix("comment").strip())
        elif fields[:1] == ["element"]:
            if len(fields) != 3 or not fields[2].isdecimal() or len(fields[2]) > 18:
                raise InputError(f"mesh {str(path)!r}: the header says {line[:60]!r}, expected a name and a number")
            elements.append((fields[1], int(fields[2]), []))
        elif fields[:1] == ["property"] and elements:
            elements[-1][2].append(_property(fields[1:], form, f"mesh {str(path)!r}: the header"))
    if lines[0] != "ply" or form not in _ORDERS:
        raise InputError(f"mesh {str(path)!r}: its header says format {form[:40]!r}, expected one of "
                         f"{', '.join(_ORDERS)}: is it a .ply file?")
    for name, _, properties in elements:
        names = [p.name for p in properties]
        if len(set(names)) < len(names) or [other for other, _, _ in elements].count(name) > 1:
            raise InputError(f"mesh {str(path)!r}: its header names an element or a property of {name!r} twice")
    return Header(form, elements, comments, start)


def _property(fields: list[str], form: str, what: str) -> Property:
    is_list = fields[:1] == ["list"]
    kinds, name = (fields[1:3], fields[3:]) if is_list else (fields[:1], fields[1:])
    if len(name) != 1 or not {*kinds} <= _TYPES.keys() or form not in _ORDERS:
        raise InputError(f"{what} says 'property {' '.join(fields)[:60]}', expected a format before it, a type "
                         f"({', '.join(_TYPES)}; or list and two types) and a name")
    stored = [np.dtype("=f8" if form == "ascii" else _ORDERS[form] + _TYPES[kind]) for kind in kinds]
    return Property(name[0], np.dtype(_TYPES[kinds[-1]]), stored[-1], stored[0] if is_list else None)


def is_marked(path: Path) -> bool:
    """Whether the header has the mark of files that pagas_cl wrote."""
    with open(path, "rb") as file:
        return MARK in header_of(file.read(HEADER), path).comments
