""".off files, as text: vertices with the normals and colours that they may have, polygons split into triangles. trimesh
drops normals and colours without a word, and writes ten digits."""

import re
from pathlib import Path

import numpy as np

from pagas_cl.errors import InputError
from pagas_cl.scene.mesh import Surface
from pagas_cl.scene.meshes.content import MeshContent, Parts, numbers, split_corners, whole
from pagas_cl.scene.own_files import TEXT_MARK
from pagas_cl.system.files import read_bytes

_FIRST = re.compile(rb"(ST)?(C?N?|NC)OFF$")      # further letters are of more dimensions than three


def read_off(path: Path, parts: Parts) -> MeshContent:
    """InputError where it is damaged, or binary, or of more dimensions than three."""
    what = f"mesh {str(path)!r}"
    content = read_bytes(path, 1 << 40)
    lines = [line for line in (line.partition(b"#")[0].strip() for line in content.splitlines()) if line]
    fields = lines[0].split() if lines else []
    first = _FIRST.match(fields[0]) if fields else None
    if first is None:
        raise InputError(f"{what} begins with {(fields or [b''])[0][:20]!r}, expected OFF, COFF, NOFF or CNOFF of "
                         "three dimensions: is it a .off file as text?")
    lines[:1] = [b" ".join(fields[1:])] if len(fields) > 1 else []
    claimed = numbers(lines[0] if lines else b"")
    if len(claimed) < 2:
        raise InputError(f"{what}: the numbers of its vertices and faces do not follow {fields[0].decode()}")
    most = len(content)
    if not 0 <= claimed[:2].sum() <= most:
        raise InputError(f"{what} claims {claimed[:2].sum():.0f} vertices and faces but has {most} bytes: is the file "
                         "damaged or cut off?")
    vertex_count, face_count = whole(claimed[:2], f"{what} claims a number of", 0, most).tolist()
    of_vertices, of_faces = lines[1:vertex_count + 1], lines[vertex_count + 1:vertex_count + face_count + 1]
    if len(of_faces) < face_count or len(of_vertices) < vertex_count:
        raise InputError(f"{what} claims {vertex_count} vertices and {face_count} faces, and has {len(lines) - 1} "
                         "lines for them: the file is cut off, copy or write it again")
    vertices, normals, colors, lost = _vertices(of_vertices, first[1] is not None, first[2], what)
    faces, more = _faces(of_faces, vertices, what)
    return MeshContent(vertices, faces, normals, colors, lost=lost + more)


def _vertices(lines: list[bytes], has_texture: bool, letters: bytes, what: str
              ) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None, tuple[str, ...]]:
    """Vertices, normals and colours; the first line says what all of them have."""
    lost = ("texture coordinates",) * has_texture
    if not lines:
        return np.empty((0, 3)), None, None, lost
    values, width = numbers(b" ".join(lines)), len(lines[0].split())
    if len(values) != width * len(lines) or any(len(line.split()) != width for line in lines):
        raise InputError(f"{what}: its vertices do not all have {width} numbers, as the first one has")
    table = values.reshape(-1, width)
    at_colors = 6 if b"N" in letters else 3
    at_end = width - 2 * has_texture
    if at_end < at_colors + 3 * (b"C" in letters):
        raise InputError(f"{what}: its vertices have {width} numbers, fewer than its first line says")
    normals = table[:, 3:6] if b"N" in letters else None
    colors = None
    if b"C" in letters:
        colors = table[:, at_colors:at_colors + 3] / (1 if b"." in lines[0].split()[at_colors] else 255)
        opacity = table[:, at_colors + 3:at_end]
        lost += ("the opacity of vertices",) * bool((opacity != opacity[:1]).any())
    return table[:, :3], normals, colors, lost


def _faces(lines: list[bytes], vertices: np.ndarray, what: str) -> tuple[np.ndarray, tuple[str, ...]]:
    """Faces (F, 3), and what they have besides corners."""
    widths = np.array([len(line.split()) for line in lines], np.int64)
    values, starts = numbers(b" ".join(lines)), np.cumsum(widths) - widths
    counts = whole(values[starts], f"{what}: a face claims a number of corners, which is", 0, len(values))
    if (counts >= widths).any():
        row = int(np.argmax(counts >= widths))
        raise InputError(f"{what}: face {row} claims {counts[row]} corners and names {widths[row] - 1}")
    place = np.arange(len(values)) - np.repeat(starts, widths)
    corners = values[(place > 0) & (place <= np.repeat(counts, widths))]
    faces, lost = split_corners(vertices, corners, counts, what)
    return faces, (*lost, *["face colours"] * bool((widths > counts + 1).any()))


def write_off(path: Path, surface: Surface) -> None:
    """All digits of vertices and normals, colours in 8 bits."""
    columns = [surface.vertices.tolist()]
    letters = ""
    if surface.normals is not None:
        columns.append(surface.normals.tolist())
        letters = "N"
    if surface.colors is not None:
        opaque = np.full((len(surface.vertices), 4), 255)
        opaque[:, :3] = np.rint(np.clip(surface.colors, 0, 1) * 255)
        columns.append(opaque.tolist())
        letters = "C" + letters
    with open(path, "w", encoding="ascii", newline="\n") as file:
        file.write(f"{letters}OFF\n{len(surface.vertices)} {len(surface.faces)} 0\n")
        file.writelines(" ".join(map(repr, sum(row, []))) + "\n" for row in zip(*columns, strict=True))
        file.writelines(f"3 {a} {b} {c}\n" for a, b, c in surface.faces.tolist())
        file.write(f"# {TEXT_MARK}\n")     # a comment further up has assimp (Open3D's tensor reader) read without end
