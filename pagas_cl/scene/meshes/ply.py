""".ply files, binary and as text: every number of their vertices, polygons split into triangles, every index and count
checked. trimesh refuses binary files in which polygons differ in their number of corners, and writes float32."""

import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pagas_cl.errors import InputError
from pagas_cl.scene.mesh import Surface
from pagas_cl.scene.meshes.content import MeshContent, Parts, numbers, split_corners
from pagas_cl.scene.own_files import TEXT_MARK
from pagas_cl.system.files import opened, read_bytes

_HEADER = 1 << 16        # bytes of a file in which its header must end
_TYPES = {"char": "i1", "uchar": "u1", "int8": "i1", "uint8": "u1", "short": "i2", "ushort": "u2", "int16": "i2",
          "uint16": "u2", "int": "i4", "uint": "u4", "int32": "i4", "uint32": "u4", "float": "f4", "float32": "f4",
          "double": "f8", "float64": "f8"}
_TYPE_NAMES = {kind: name for name, kind in reversed(_TYPES.items())}     # the short names, which all programs read
_CORNERS = ("vertex_indices", "vertex_index")
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_PLACES, _NORMALS, _COLORS = ("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue")
_MOST_BYTES = 1 << 40
_WHOLE = 1 << 24         # whole numbers up to this one are all float32


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
        corners = 3 * self.stored.itemsize if self.name in _CORNERS else 0
        return self.stored.itemsize if self.length is None else self.length.itemsize + corners


@dataclass(frozen=True)
class Header:
    form: str                                           # one of _ORDERS
    elements: list[tuple[str, int, list[Property]]]    # name, number of rows, columns
    comments: list[str]
    start: int                                          # byte at which the first row begins


class Columns(NamedTuple):
    """Values by column, of lists also their lengths: (N, K) where all are alike, else one row after the other."""

    values: dict[str, np.ndarray]
    lengths: dict[str, np.ndarray]


def read_header(path: Path) -> Header:
    """InputError where it does not end, or says what no .ply file says."""
    with opened(path, _MOST_BYTES) as file:
        head = file.read(_HEADER)
    what, lines = f"mesh {str(path)!r}", list[str]()
    start, form = 0, ""
    elements: list[tuple[str, int, list[Property]]] = []
    comments = []
    while not lines or lines[-1] != "end_header":
        end = head.find(b"\n", start)
        if end < 0:
            raise InputError(f"{what} is no .ply file, or its header has no end within {_HEADER} bytes: is the file "
                             "damaged?")
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
                raise InputError(f"{what}: the header says {line[:60]!r}, expected a name and a number")
            elements.append((fields[1], int(fields[2]), []))
        elif fields[:1] == ["property"] and elements:
            elements[-1][2].append(_property(fields[1:], form, f"{what}: the header"))
    if lines[0] != "ply" or form not in _ORDERS:
        raise InputError(f"{what}: its header says format {form[:40]!r}, expected one of {', '.join(_ORDERS)}: is it a "
                         ".ply file?")
    for name, _, properties in elements:
        names = [p.name for p in properties]
        if len(set(names)) < len(names) or [other for other, _, _ in elements].count(name) > 1:
            raise InputError(f"{what}: its header names an element or a property of {name!r} twice")
    return Header(form, elements, comments, start)


def _property(fields: list[str], form: str, what: str) -> Property:
    is_list = fields[:1] == ["list"]
    kinds, name = (fields[1:3], fields[3:]) if is_list else (fields[:1], fields[1:])
    if len(name) != 1 or not {*kinds} <= _TYPES.keys() or form not in _ORDERS:
        raise InputError(f"{what} says 'property {' '.join(fields)[:60]}', expected a format before it, a type "
                         f"({', '.join(_TYPES)}; or list and two types) and a name")
    stored = [np.dtype("=f8" if form == "ascii" else _ORDERS[form] + _TYPES[kind]) for kind in kinds]
    return Property(name[0], np.dtype(_TYPES[kinds[-1]]), stored[-1], stored[0] if is_list else None)


def read_elements(path: Path) -> tuple[Header, dict[str, Columns]]:
    """The header, and the columns of vertices and faces (and of what comes before); InputError where it is damaged."""
    header, content, what = read_header(path), read_bytes(path, _MOST_BYTES), f"mesh {str(path)!r}"
    data = np.frombuffer(_rows_as_bytes(content, header, what), np.uint8)
    found: dict[str, Columns] = {}
    start = 0
    for name, count, properties in header.elements:
        if {"vertex", "face"} <= found.keys():
            break
        found[name], start = _element(data, start, count, properties, f"{what}: element {name!r}")
    return header, found


def read_ply(path: Path, parts: Parts) -> MeshContent:
    """All numbers of its vertices; of its faces the corners. InputError where it is damaged."""
    what = f"mesh {str(path)!r}"
    header, elements = read_elements(path)
    for comment in header.comments:       # which is how MeshLab names textures; here nothing reads them
        if comment.startswith("TextureFile"):
            parts.check(comment.removeprefix("TextureFile"))
    if "vertex" not in elements:
        raise InputError(f"{what} has no vertices")
    kinds = {p.name: p.kind for name, _, properties in header.elements for p in properties if name == "vertex"}
    columns = {name: values for name, values in elements["vertex"].values.items()
               if name not in elements["vertex"].lengths}
    vertices, fields = _of_vertices(columns, kinds, what)
    faces = elements.get("face", Columns({}, {}))
    corner = next((name for name in _CORNERS if name in faces.lengths), None)
    split, lost = np.empty((0, 3), np.int64), _lost(header)
    if corner is not None:
        split, more = split_corners(vertices, faces.values[corner].ravel(), faces.lengths[corner], what)
        lost += more
    return MeshContent(vertices, split, **fields, lost=lost)


def _rows_as_bytes(content: bytes, header: Header, what: str) -> bytes | memoryview:
    """What follows the header, text as float64; InputError where there is less than the header claims."""
    claimed = sum(count for _, count, _ in header.elements)
    if claimed > len(content):
        raise InputError(f"{what} claims {claimed} vertices and faces but has {len(content)} bytes: is the file "
                         "damaged or cut off?")
    rows = memoryview(content)[header.start:]
    if header.form == "ascii":
        rows = memoryview(numbers(content[header.start:])).cast("B")      # type: ignore[arg-type]
    least = sum(count * p.least for _, count, properties in header.elements for p in properties)
    if least > rows.nbytes:
        has, takes = ((f"{rows.nbytes // 8} numbers", least // 8) if header.form == "ascii" else
                      (f"{len(content)} bytes", header.start + least))
        raise InputError(f"{what} has {has}, and what its header claims takes {takes} or more: the file is cut off, "
                         "copy or write it again")
    return rows


def _element(data: npt.NDArray[np.uint8], start: int, count: int, properties: list[Property], what: str
             ) -> tuple[Columns, int]:
    """Columns of `count` rows that begin at byte `start`, and where they end."""
    if count == 0 or not properties:
        empty = {p.name: np.empty(0, p.stored) for p in properties}
        return Columns(empty, {p.name: np.empty(0, np.int64) for p in properties if p.length is not None}), start
    first, end = _walk(data, start, 1, properties, what)
    lengths = {p.name: int(first[i, 1]) for i, p in enumerate(properties) if p.length is not None}
    if start + count * (end - start) <= len(data):       # taken for rows that are all as long as the first one
        fields: list[tuple[Any, ...]] = []
        for p in properties:
            fields += [] if p.length is None else [(f"{p.name} length", p.length)]
            fields.append((p.name, p.stored, (lengths[p.name],) if p.name in lengths else ()))
        rows = np.frombuffer(data, np.dtype(fields), count, start)
        if all((rows[f"{name} length"] == length).all() for name, length in lengths.items()):
            counts = {name: np.full(count, length) for name, length in lengths.items()}
            return Columns({p.name: rows[p.name] for p in properties}, counts), start + rows.nbytes
    places, end = _walk(data, start, count, properties, what)
    places = places.reshape(count, len(properties), 2)
    columns = Columns({}, {})
    for i, p in enumerate(properties):
        at, number = places[:, i].T
        first_value = np.repeat(at - (np.cumsum(number) - number) * p.stored.itemsize, number)
        at = first_value + np.arange(len(first_value)) * p.stored.itemsize
        columns.values[p.name] = data[at[:, None] + np.arange(p.stored.itemsize)].view(p.stored).reshape(-1)
        if p.length is not None:
            columns.lengths[p.name] = number
    return columns, end


def _walk(data: npt.NDArray[np.uint8], start: int, count: int, properties: list[Property], what: str
          ) -> tuple[npt.NDArray[np.int64], int]:
    """Where values of each property begin in each row, and how many there are: (count * properties, 2); the end."""
    places = []
    steps = [(None if p.length is None else struct.Struct(p.length.str[0].replace("|", "<") + p.length.char), p)
             for p in properties]
    rows = data.data
    for row in range(count):
        for unpack, p in steps:
            number = 1
            if unpack is not None:
                if start + unpack.size > len(data):
                    raise InputError(f"{what}: row {row} is not there: the file is cut off, copy or write it again")
                length = unpack.unpack_from(rows, start)[0]
                if not 0 <= length <= len(data) or length != int(length):
                    raise InputError(f"{what}: a list in row {row} has {length:g} values: is the file damaged?")
                number, start = int(length), start + unpack.size
            places.append((start, number))
            start += number * p.stored.itemsize
            if start > len(data):
                raise InputError(f"{what}: row {row} goes beyond the end of the file: is it damaged or cut off?")
    return np.array(places, np.int64), start


def _of_vertices(columns: dict[str, np.ndarray], kinds: dict[str, np.dtype], what: str
                 ) -> tuple[np.ndarray, dict[str, Any]]:
    """Vertices (V, 3), and the other fields of a MeshContent that are theirs."""
    if not {*_PLACES} <= columns.keys():
        raise InputError(f"{what}: its vertices have no x, y and z")

    def stacked(wanted: tuple[str, ...]) -> np.ndarray | None:
        """(V, 3), whole numbers as shares of their largest one."""
        if not {*wanted} <= columns.keys():
            return None
        kind = kinds[wanted[0]]
        values = np.stack([columns[name] for name in wanted], axis=1).astype(np.float64)
        return values / np.iinfo(kind).max if kind.kind in "iu" else values

    others = {name: values.astype(np.float64) for name, values in columns.items()
              if name not in {*_PLACES, *_NORMALS, *_COLORS, "quality"}}
    return np.stack([columns[name] for name in _PLACES], axis=1), {
        "normals": stacked(_NORMALS), "colors": stacked(_COLORS), "quality": columns.get("quality"),
        "attributes": others}


def _lost(header: Header) -> tuple[str, ...]:
    """In words, what is not read: columns of faces but their corners, lists of vertices, other elements."""
    lost = []
    for element, count, properties in header.elements:
        if element == "vertex":
            lost += [f"vertex property {p.name!r}" for p in properties if p.length is not None]
        elif element == "face":
            lost += [f"face property {p.name!r}" for p in properties if p.name not in _CORNERS]
        elif count:
            lost.append(f"elements {element!r}")
    return tuple(lost)


def write_ply(path: Path, surface: Surface) -> None:
    """Vertices as double, colours in 8 bits, other numbers as float (double where whole ones need it)."""
    columns = dict(zip(_PLACES, surface.vertices.T))
    if surface.normals is not None:
        columns.update(zip(_NORMALS, surface.normals.T.astype(np.float32)))
    if surface.colors is not None:
        columns.update(zip(_COLORS, np.rint(np.clip(surface.colors.T, 0, 1) * 255).astype(np.uint8)))
    if surface.quality is not None:
        columns["quality"] = surface.quality.astype(np.float32)
    for name, values in surface.attributes.items():
        if not name.isascii() or name.split() != [name] or name in columns:
            raise InputError(f"mesh attribute {name!r} cannot be named so in a .ply file, expected ASCII without "
                             "spaces that is no other column's name")
        large = bool((np.abs(values) > _WHOLE).any() and (values == np.rint(values)).all())
        columns[name] = values.astype(np.float64 if large else np.float32)
    write_elements(path, [TEXT_MARK], {"vertex": columns, "face": {_CORNERS[0]: surface.faces}})


def write_elements(path: Path, comments: Iterable[str], elements: Mapping[str, Mapping[str, np.ndarray]]) -> None:
    """A binary .ply: of each element the columns by name, (N,) numbers or (N, K) lists, in their order."""
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {comment}" for comment in comments)]
    tables = []
    for element, columns in elements.items():
        count = len(next(iter(columns.values())))
        header.append(f"element {element} {count}")
        fields: list[tuple[Any, ...]] = []
        for name, column in columns.items():
            kind = column.dtype.str[1:]
            header.append(f"property {'list uchar ' if column.ndim == 2 else ''}{_TYPE_NAMES[kind]} {name}")
            if column.ndim == 2:
                fields.append((f"{name} length", "u1"))
            fields.append((name, f"<{kind}", column.shape[1:]))
        table = np.empty(count, np.dtype(fields))
        for name, column in columns.items():
            table[name] = column
            if column.ndim == 2:
                table[f"{name} length"] = column.shape[1]
        tables.append(table)
    with open(path, "wb") as file:
        file.write("\n".join([*header, "end_header", ""]).encode("utf-8", "surrogateescape"))
        for table in tables:
            file.write(table.data)
