""".stl files, binary and as text; corners in one place become one vertex. trimesh drops a solid that is cut off."""

from pathlib import Path

import numpy as np

from pagas_cl.errors import InputError
from pagas_cl.scene.mesh import Surface, triangle_normals
from pagas_cl.scene.meshes.content import MeshContent, Parts, numbers
from pagas_cl.scene.own_files import TEXT_MARK
from pagas_cl.system.files import read_bytes

HEADER = 80
_ROW = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def read_stl(path: Path, parts: Parts) -> MeshContent:
    """InputError where it is damaged, or has other than the triangles that it claims."""
    content, what = read_bytes(path, 1 << 40), f"mesh {str(path)!r}"
    claimed = int.from_bytes(content[HEADER:HEADER + 4], "little")
    binary = len(content) == HEADER + 4 + claimed * _ROW.itemsize
    if not binary and not content.lstrip()[:5].lower() == b"solid":
        raise InputError(f"{what} claims {claimed} triangles, which take {HEADER + 4 + claimed * _ROW.itemsize} bytes, "
                         f"and has {len(content)} bytes: the file is damaged or cut off, copy or write it again")
    if binary:
        rows = np.frombuffer(content, _ROW, claimed, HEADER + 4)
        corners = rows["corners"].reshape(-1, 3).astype(np.float64)
        lost = ("face attributes",) * bool(rows["attribute"].any())
    else:
        corners, lost = _corners_of_text(content.lower(), what)
    vertices, faces = np.unique(corners, axis=0, return_inverse=True)
    return MeshContent(vertices, faces.reshape(-1, 3), lost=lost)


def _corners_of_text(content: bytes, what: str) -> tuple[np.ndarray, tuple[str, ...]]:
    """Corners (3 F, 3) of all triangles, and in words what is not kept of them."""
    rows = [line.split(None, 1) for line in content.splitlines()]
    places = [row[1] for row in rows if row[0:1] == [b"vertex"] and len(row) > 1]
    counts = [sum(row[0:1] == [first] for row in rows) for first in (b"facet", b"endfacet", b"endsolid")]
    if any(len(place.split()) != 3 for place in places) or [len(places), len(places)] != [3 * n for n in counts[:2]]:
        raise InputError(f"{what} has {counts[0]} triangles as text, expected each to have three vertices of three "
                         "numbers: is the file damaged or cut off?")
    return numbers(b" ".join(places)).reshape(-1, 3), (f"{counts[2]} solids",) * (counts[2] > 1)


def write_stl(path: Path, surface: Surface) -> None:
    """Binary, as float32: `files.check_digits` says whether that is enough."""
    rows = np.zeros(len(surface.faces), _ROW)
    rows["corners"] = surface.vertices[surface.faces]
    across = triangle_normals(surface.vertices, surface.faces)
    rows["normal"] = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), np.finfo(float).tiny)
    with open(path, "wb") as file:
        file.write(TEXT_MARK.encode().ljust(HEADER) + len(rows).to_bytes(4, "little"))
        rows.tofile(file)
