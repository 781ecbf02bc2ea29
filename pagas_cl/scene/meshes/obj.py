""".obj files: vertices in double precision that are not split where textures have seams, polygons split into triangles,
materials read from their libraries (.mtl) and written with the mesh, each with its statements and images. trimesh makes
several vertices of one at a seam, and says nothing of the statements that it leaves out."""

import re
import shutil
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

import numpy as np

from pagas_cl.errors import InputError
from pagas_cl.scene.mesh import Material, Surface, Texture
from pagas_cl.scene.meshes.content import MeshContent, Parts, numbers, polygon_triangles, text_of_line, whole
from pagas_cl.scene.own_files import TEXT_MARK
from pagas_cl.system.files import read_bytes

_IMAGES = ("map_", "bump", "disp", "refl", "norm", "decal")      # statements that end in a file's name begin so
_READ = {b"v", b"vt", b"vn", b"f", b"mtllib", b"g", b"o", b"s"}
_MARKS_OF_NUMBERS = b"0123456789+-"
_SHAPES = {b" ": 1, b"/ ": 2, b"// ": 3}   # of a corner: v, v/vt, v/vt/vn


@dataclass
class _Statements:
    """What follows each first word; how many v, vt and vn came before each face; materials' first face and name."""

    lines: defaultdict[bytes, list[bytes]]
    before: list[tuple[int, int, int]]
    materials: list[tuple[int, str]]


def read_obj(path: Path, parts: Parts) -> MeshContent:
    """InputError where it is damaged, or names files that `parts` does not allow."""
    what = f"mesh {str(path)!r}"
    found = _statements(read_bytes(path, 1 << 40))
    lines, has_materials = found.lines, bool(found.materials)
    if not has_materials or found.materials[0][0] > 0:      # the first faces have none
        found.materials.insert(0, (0, ""))
    first, names = zip(*found.materials, strict=True)
    described: dict[str, list[tuple[str, Path | None]]] = {}
    for line in lines[b"mtllib"]:
        for _, file in parts.check(text_of_line(line.strip())):
            _read_library(file, parts, described)
    library = tuple(Material(name, tuple(described.get(name, ()))) for name in dict.fromkeys(names))
    table = _table(lines[b"v"], 3, f"{what}: vertex")
    vertices, colors = table[:, :3], table[:, 3:6] if table.shape[1] >= 6 else None
    if not found.before:
        return MeshContent(vertices, np.empty((0, 3), np.int64), None, colors, lost=_lost(lines, 0))
    counts, corners = _corners(found, what)
    sizes = (len(vertices), len(lines[b"vt"]), len(lines[b"vn"]))
    for column, (size, kind) in enumerate(zip(sizes, ("vertex", "texture coordinate", "normal"), strict=True)):
        whole(corners[:, column], f"{what}: a face names {kind} (counted from 0)", -1 if column else 0, size - 1)
    triangles, polygons = polygon_triangles(vertices, corners[:, 0], counts)
    faces = corners[triangles]
    normals = _normals(lines[b"vn"], faces, len(vertices), what)
    texture = None
    if lines[b"vt"] or has_materials:
        order = {material.name: i for i, material in enumerate(library)}
        of_faces = np.repeat([order[name] for name in names], np.diff([*first, len(counts)])).astype(np.int32)
        at = faces[:, :, 1]
        coordinates = None if (at < 0).all() else np.where(
            at[..., None] < 0, np.nan, _table(lines[b"vt"], 2, f"{what}: texture coordinate")[:, :2][at])
        texture = Texture(coordinates, of_faces[polygons], library)
    return MeshContent(vertices, faces[:, :, 0], normals, colors, texture=texture,
                       lost=_lost(lines, int((counts < 3).sum())))


def _statements(content: bytes) -> _Statements:
    found = _Statements(defaultdict(list), [], [])
    v, vt, vn, faces = (found.lines[word] for word in (b"v", b"vt", b"vn", b"f"))
    for line in re.sub(rb"\\\r?\n", b" ", content).splitlines():
        word, _, rest = line.replace(b"\t", b" ").strip().partition(b" ")
        if word in (b"f", b"fo"):
            faces.append(rest)
            found.before.append((len(v), len(vt), len(vn)))
        elif word == b"usemtl":
            found.materials.append((len(faces), text_of_line(rest.strip())))
        elif word in _READ:
            found.lines[word].append(rest)
        elif word and not word.startswith(b"#"):
            found.lines.setdefault(word, [])
    return found


def _table(lines: list[bytes], least: int, what: str) -> np.ndarray:
    """Numbers (lines, columns) of lines that all have as many, `least` or more: as many as the shortest one has."""
    widths = np.array([len(line.split()) for line in lines], np.int64)
    if not len(widths):
        return np.empty((0, least))
    columns = int(widths.min())
    if columns < least:
        raise InputError(f"{what} number {int(widths.argmin()) + 1} has {columns} numbers, expected {least} or more: "
                         "is the file damaged?")
    values, starts = numbers(b" ".join(lines)), np.cumsum(widths) - widths
    table: np.ndarray = values[starts[:, None] + np.arange(columns)]
    return table


def _corners(found: _Statements, what: str) -> tuple[np.ndarray, np.ndarray]:
    """How many corners each face has, and of each its vertex, texture coordinate, normal: (corners, 3), -1 = none."""
    faces = found.lines[b"f"]
    counts = np.array([len(line.split()) for line in faces], np.int64)
    total = int(counts.sum())
    text = b" ".join(b" ".join(faces).split()).replace(b"//", b"/0/") + b" "
    slashes = text.translate(None, _MARKS_OF_NUMBERS)
    columns = next((columns for shape, columns in _SHAPES.items() if slashes == shape * total), 0)
    values = numbers(text.replace(b"/", b" ")) if columns else np.empty(0)
    given = np.zeros((total, 3))
    if columns and len(values) == total * columns:
        given[:, :columns] = values.reshape(total, -1)
    else:
        given[:] = [_corner(word, what) for word in b" ".join(faces).split()]
    numbered = whole(given.reshape(-1), f"{what}: a face names", -(1 << 40), 1 << 40).reshape(-1, 3)
    before = np.repeat(np.array(found.before, np.int64).reshape(-1, 3), counts, axis=0)
    if (numbered[:, 0] == 0).any():
        raise InputError(f"{what}: a face names vertex 0, expected 1 or more, or -1 or less to count from the last one")
    back = np.where(numbered < 0, before + numbered, numbered - 1)
    if (back[numbered != 0] < 0).any():
        raise InputError(f"{what}: a face counts back beyond the first vertex, texture coordinate or normal")
    return counts, back


def _corner(word: bytes, what: str) -> list[int]:
    parts = word.split(b"/")
    if not 1 <= len(parts) <= 3 or not parts[0] or any(len(part) > 18 for part in parts):
        raise InputError(f"{what}: a face has the corner {word[:40]!r}, expected v, v/vt, v//vn or v/vt/vn")
    return [int(part or b"0") for part in parts] + [0] * (3 - len(parts))


def _normals(lines: list[bytes], faces: np.ndarray, count: int, what: str) -> np.ndarray | None:
    """(V, 3): the mean of the normals that a vertex has in faces; None where a vertex of a face has none."""
    if not lines or (faces[:, :, 2] < 0).any():
        return None
    of_corners = _table(lines, 3, f"{what}: normal")[faces[:, :, 2].ravel(), :3]
    mean = np.stack([np.bincount(faces[:, :, 0].ravel(), of_corners[:, k], count) for k in range(3)], axis=1)
    with np.errstate(all="ignore"):     # numbers of a damaged file may be anything
        lengths = np.linalg.norm(mean, axis=1, keepdims=True)
        unit: np.ndarray = np.divide(mean, lengths, out=np.zeros_like(mean), where=lengths > 0)
    return unit


def _lost(lines: dict[bytes, list[bytes]], without_area: int) -> tuple[str, ...]:
    """In words, what is not read: one group or object is a name, several are parts."""
    lost = [f"{len(names)} {word}" for key, word in ((b"g", "groups"), (b"o", "objects"))
            if len(names := {*lines[key]}) > 1]
    lost += [f"statements {text_of_line(word[:20])!r}" for word in sorted({*lines} - _READ)[:5]]
    return (*lost, *[f"{without_area} faces of fewer than 3 corners"] * bool(without_area))


def _read_library(path: Path, parts: Parts, found: dict[str, list[tuple[str, Path | None]]]) -> None:
    """Add the statements of each material to `found`; those that name an image without the name, and with its path."""
    statements: list[tuple[str, Path | None]] = []
    for line in read_bytes(path, 1 << 30).replace(b"\\\r\n", b" ").replace(b"\\\n", b" ").splitlines():
        text = text_of_line(line).replace("\t", " ").strip()
        word, _, rest = text.partition(" ")
        if word.lower() == "newmtl":
            statements = found.setdefault(rest.strip(), [])
        elif word.lower().startswith(_IMAGES):
            named = [pair for pair in parts.check(rest) if text.endswith(pair[0])]
            name, image = named[0] if named else ("", None)
            statements.append((text.removesuffix(name).strip(), image))
        elif text and not text.startswith("#"):
            statements.append((text, None))


def write_obj(path: Path, surface: Surface) -> None:
    """All digits of coordinates; materials next to it in a .mtl file, images under names that begin like its own."""
    texture = surface.texture
    with open(path, "w", encoding="utf-8", errors="surrogateescape", newline="\n") as file:
        file.write(f"# {TEXT_MARK}\n")
        if texture is not None and any(material.name for material in texture.library):
            _write_library(path.with_suffix(".mtl"), texture.library)
            file.write(f"mtllib {path.stem}.mtl\n")
        rows = surface.vertices.tolist()
        if surface.colors is not None:
            rows = [a + b for a, b in zip(rows, surface.colors.tolist(), strict=True)]
        file.writelines(f"v {' '.join(map(repr, row))}\n" for row in rows)
        if surface.normals is not None:
            file.writelines(f"vn {x!r} {y!r} {z!r}\n" for x, y, z in surface.normals.tolist())
        numbers = np.zeros((len(surface.faces), 3), np.int64)
        if texture is not None and texture.coordinates is not None:
            given = np.isfinite(texture.coordinates).all(axis=(1, 2))
            rows_of, place = np.unique(texture.coordinates[given].reshape(-1, 2), axis=0, return_inverse=True)
            numbers[given] = place.reshape(-1, 3) + 1
            file.writelines(f"vt {u!r} {v!r}\n" for u, v in rows_of.tolist())
        _write_faces(file, surface, numbers)


def _write_faces(file: TextIO, surface: Surface, numbers: np.ndarray) -> None:
    """`numbers` (F, 3) are those of texture coordinates, 0 where there are none."""
    texture, used = surface.texture, -1
    materials = [0] * len(numbers) if texture is None else texture.materials.tolist()
    normal = surface.normals is not None
    for corners, places, material in zip((surface.faces + 1).tolist(), numbers.tolist(), materials, strict=True):
        if texture is not None and material != used:
            used = material
            if len(texture.library) > 1 or texture.library[used].name:
                file.write(f"usemtl {texture.library[used].name or 'none'}\n")
        references = [f"{corner}/{place or ''}/{corner}" if normal else f"{corner}/{place}" if place else str(corner)
                 for corner, place in zip(corners, places, strict=True)]
        file.write(f"f {' '.join(references)}\n")


def _write_library(path: Path, library: tuple[Material, ...]) -> None:
    names: dict[Path, str] = {}
    with open(path, "w", encoding="utf-8", errors="surrogateescape", newline="\n") as file:
        file.write(f"# {TEXT_MARK}\n")
        for material in library:
            file.write(f"newmtl {material.name}\n")
            for text, image in material.statements:
                if image is None:
                    file.write(f"{text}\n")
                    continue
                if image not in names:
                    names[image] = f"{path.stem}_{len(names)}{image.suffix}"
                    shutil.copyfile(image, path.with_name(names[image]))
                file.write(f"{text} {names[image]}\n")
