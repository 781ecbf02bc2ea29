"""Writing a mesh file: .ply by NumPy alone with everything that a Surface has, other kinds through Open3D."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from pagas_cl.errors import InputError, need
from pagas_cl.scene.mesh import Surface, to_legacy

SUFFIXES = (".ply", ".obj", ".stl", ".off")


def check_mesh_path(path: str | Path) -> None:
    """Raise InputError for a name that `write_mesh` could not write to: said before the work, not after it."""
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"mesh {str(path)!r}: unknown kind {path.suffix!r}, expected one of {', '.join(SUFFIXES)}")
    if path.is_dir():
        raise InputError(f"mesh {str(path)!r} is a folder, expected a file name")
    if path.suffix.lower() != ".ply":
        need("open3d", "mesh", f"writing {path.suffix} files")


def write_mesh(path: str | Path, surface: Surface) -> None:
    """Write `surface` beside the name `path` first, then rename it; folders are made.

    .ply: binary, vertices as double, normals and quality (MeshLab's vertex quality) as float, colours as 8 bit. The
    other kinds keep what Open3D writes.
    """
    path = Path(path)
    check_mesh_path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
    try:
        if path.suffix.lower() == ".ply":
            _write_ply(beside, surface)
        else:
            _write_by_open3d(beside, surface, path)
        os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)


def _write_ply(path: Path, surface: Surface) -> None:
    columns: list[tuple[str, str, str, np.ndarray]]  # name, dtype, type in the header, values
    columns = [(axis, "<f8", "double", surface.vertices[:, i]) for i, axis in enumerate("xyz")]
    if surface.normals is not None:
        columns += [("n" + axis, "<f4", "float", surface.normals[:, i]) for i, axis in enumerate("xyz")]
    if surface.colors is not None:
        rgb = np.rint(np.clip(surface.colors, 0, 1) * 255).astype(np.uint8)
        columns += [(name, "u1", "uchar", rgb[:, i]) for i, name in enumerate(("red", "green", "blue"))]
    if surface.quality is not None:
        columns.append(("quality", "<f4", "float", surface.quality))
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
        file.write(vertices.tobytes())
        file.write(faces.tobytes())


def _write_by_open3d(beside: Path, surface: Surface, path: Path) -> None:
    o3d, mesh = need("open3d", "mesh", f"writing {path.suffix} files"), to_legacy(surface)
    if path.suffix.lower() == ".stl":
        mesh.compute_triangle_normals()  # the format is made of them
    if not o3d.io.write_triangle_mesh(str(beside), mesh):
        raise OSError(f"Open3D could not write {str(path)!r}")
