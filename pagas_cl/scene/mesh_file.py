"""Mesh files: binary .ply of triangles by NumPy alone, with all that a Surface has (ply.py), others by Open3D."""

import re
from functools import partial
from pathlib import Path
from typing import Any

from pagas_cl.errors import InputError, need
from pagas_cl.scene.files import replaced, replaced_with_others
from pagas_cl.scene.mesh import Surface, from_legacy, to_legacy
from pagas_cl.scene.ply import CORNERS, HEADER, TYPES, header_of, read_ply, write_ply
from pagas_cl.scene.readers.mesh_parts import check_parts

SUFFIXES = (".ply", ".obj", ".stl", ".off")


def read_mesh(path: str | Path) -> Surface:
    """Read a mesh file: a binary .ply of triangles with all numbers of its vertices, others (.ply, .obj, .stl, .off,
    .glb ...) through Open3D."""
    path, fields = Path(path), None
    if path.suffix.lower() == ".ply":
        _check_file(path)
        fields = read_ply(path)
    made = partial(from_legacy, read_open3d(path)) if fields is None else partial(Surface, **fields)
    try:
        return made()
    except InputError as error:
        raise InputError(f"{str(path)!r}: {error}") from error


def read_open3d(path: str | Path, textures: bool = False) -> Any:
    """A mesh file as an Open3D legacy TriangleMesh; InputError where it is none, or claims more than it holds."""
    path = Path(path)
    _check_file(path)
    o3d = need("open3d", "mesh", "reading a mesh file that is no binary .ply of triangles")
    check_parts(path)
    try:
        with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
            mesh = o3d.io.read_triangle_mesh(str(path), textures)
    except MemoryError as error:
        raise InputError(f"mesh {str(path)!r} does not fit into memory, or claims more than it holds") from error
    if len(mesh.vertices) == 0:
        raise InputError(f"mesh {str(path)!r} has no vertices, or is no mesh file that Open3D reads (.ply, .obj, .stl, "
                         ".off, .gltf)")
    return mesh


def _check_file(path: Path) -> None:
    """InputError where there is none, a .ply or .off file claims more elements than it has bytes, or a binary .ply is
    cut off."""
    if not path.is_file():
        raise InputError(f"mesh {str(path)!r} "
                         + ("is a folder, expected a file" if path.is_dir() else "does not exist"))
    size = path.stat().st_size
    with open(path, "rb") as file:
        head = file.read(HEADER)
    claimed, least = _claims(head)
    if claimed > size:
        raise InputError(f"mesh {str(path)!r} claims {claimed} vertices and faces but has {size} bytes: is the file "
                         "damaged or cut off?")
    if least > size:
        raise InputError(f"mesh {str(path)!r} has {size} bytes, and what its header claims takes {least} or more: the "
                         "file is cut off, copy or write it again")


def _claims(head: bytes) -> tuple[int, int]:
    """Number of elements that the first bytes of a .ply or .off file claim, and the fewest bytes that a binary .ply
    with this header has, its faces triangles; 0 of what the format does not claim."""
    if head[:3] != b"ply":
        off = re.match(rb"\s*(?:ST|C|N|4|n)*OFF\s*(?:#[^\n]*\n\s*)*(\d{1,20})\s+(\d{1,20})", head)
        return sum(int(n) for n in off.groups()) if off else 0, 0
    kind, elements, start = header_of(head)
    least = start + sum(count * _bytes(words) for _, count, properties in elements for words in properties)
    return sum(count for _, count, _ in elements), least if start and kind.startswith("binary") else 0


def _bytes(words: list[str]) -> int:
    """Fewest that a property takes, its words those of the header."""
    if words[:1] == ["list"] and len(words) == 4:
        kinds = [words[1], *[words[2]] * (3 if words[3] in CORNERS else 0)]
    else:
        kinds = words[:1] if len(words) == 2 else []
    return sum(int(TYPES.get(kind, "f0")[1:]) for kind in kinds)


def check_mesh_file(path: str | Path, *, outside: bool = False) -> None:
    """Raise InputError for a mesh file that a native reader (pymeshlab, Open3D) must not be handed: damaged, more
    claimed than it holds, an index out of range, no regular file, or, without `outside`, one that names files out of
    its folder. To be called before any such reader opens `path`; a point cloud is no error."""
    path = Path(path)
    _check_file(path)
    check_parts(path, outside=outside)


def written_by_pagas_cl(path: str | Path) -> bool:
    """Whether the mesh file `path` carries the mark of files that pagas_cl wrote; false where it does not exist or
    cannot be read."""
    return False


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
    """Write `surface`; folders are made, and the final name never holds half of it.

    .ply as write_ply; of other kinds what Open3D writes.
    """
    path = Path(path)
    check_mesh_path(path)
    # what is not NumPy's work may write the file's name into it, or other files beside it
    with replaced(path) if path.suffix.lower() == ".ply" else replaced_with_others(path) as beside:
        if path.suffix.lower() == ".ply":
            write_ply(beside, surface)
            return
        o3d, mesh = need("open3d", "mesh", f"writing {path.suffix} files"), to_legacy(surface)
        if path.suffix.lower() == ".stl":
            mesh.compute_triangle_normals()  # the format is made of them
        if not o3d.io.write_triangle_mesh(str(beside), mesh):
            raise OSError(f"Open3D could not write {str(path)!r}")
