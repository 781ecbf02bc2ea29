""".stl files, binary and as text, by trimesh; corners in the very same place become one vertex."""

import io
from pathlib import Path

import numpy as np

from pagas_cl.errors import InputError
from pagas_cl.scene.files import read_bytes
from pagas_cl.scene.mesh import Surface, triangle_normals
from pagas_cl.scene.mesh_content import MARK, MeshContent
from pagas_cl.scene.readers.mesh_parts import Parts

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
    import trimesh  # takes a second

    loaded = trimesh.load_scene(io.BytesIO(content), file_type="stl", process=False)
    solids = [solid for solid in loaded.geometry.values() if len(solid.faces)]
    corners = np.concatenate([np.empty((0, 3)), *[solid.vertices[solid.faces].reshape(-1, 3) for solid in solids]])
    # trimesh passes over what it cannot read in a text
    if not binary and 3 * content.lower().count(b"outer loop") != len(corners):
        raise InputError(f"{what} has a triangle that is not three vertices of three numbers: is the file damaged?")
    lost: tuple[str, ...] = (f"{len(solids)} solids",) * (len(solids) > 1)
    if binary and np.frombuffer(content, _ROW, claimed, HEADER + 4)["attribute"].any():
        lost += ("face attributes",)
    vertices, faces = np.unique(corners, axis=0, return_inverse=True)
    return MeshContent(vertices, faces.reshape(-1, 3), lost=lost)


def write_stl(path: Path, surface: Surface) -> None:
    """Binary, as float32: `mesh_file.check_digits` says whether that is enough."""
    rows = np.zeros(len(surface.faces), _ROW)
    rows["corners"] = surface.vertices[surface.faces]
    across = triangle_normals(surface.vertices, surface.faces)
    rows["normal"] = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), np.finfo(float).tiny)
    with open(path, "wb") as file:
        file.write(MARK.encode().ljust(HEADER) + len(rows).to_bytes(4, "little"))
        rows.tofile(file)
