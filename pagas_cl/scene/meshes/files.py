"""Mesh files, read and written by format: no file reaches another library but after every index and count of it has
been checked, and none loses digits of its coordinates in silence. A new format is a module with a reader (and a writer,
where it has one) and a line in FORMATS."""

import os
import stat
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pagas_cl.errors import InputError
from pagas_cl.scene.mesh import Surface
from pagas_cl.scene.meshes import gltf, obj, off, ply, stl
from pagas_cl.scene.meshes.content import MeshContent, Parts
from pagas_cl.system import child
from pagas_cl.system.files import replaced, replaced_with_others, translated

_NORMALS, _COLORS, _TEXTURE, _NUMBERS = "normals", "vertex colours", "texture coordinates", "numbers"
_ROUNDING, _AHEAD = 1e-2, 0.1              # of the median edge; by so much refined edges may be shorter
_OF_CAMERAS = 1e-4                         # of the extent of cameras: a tenth of a pixel of a wide photo, or less
_KINDS = {stat.S_IFIFO: "a named pipe", stat.S_IFCHR: "a device", stat.S_IFBLK: "a device", stat.S_IFSOCK: "a socket",
          stat.S_IFDIR: "a folder"}
_SECONDS, _BYTES_A_SECOND = 60.0, 1e6      # that another program's reader may take


@dataclass(frozen=True)
class MeshFormat:
    """`keeps`: what a written file holds besides triangles; `single`: whether its coordinates are float32."""

    read: Callable[[Path, Parts], MeshContent]
    write: Callable[[Path, Surface], None] | None = None
    keeps: tuple[str, ...] = ()
    single: bool = False


FORMATS = {
    ".ply": MeshFormat(ply.read_ply, ply.write_ply, (_NORMALS, _COLORS, _NUMBERS)),
    ".obj": MeshFormat(obj.read_obj, obj.write_obj, (_NORMALS, _COLORS, _TEXTURE)),
    ".stl": MeshFormat(stl.read_stl, stl.write_stl, single=True),
    ".off": MeshFormat(off.read_off, off.write_off, (_NORMALS, _COLORS)),
    ".glb": MeshFormat(gltf.read_gltf, gltf.write_glb, (_NORMALS, _COLORS), True),
    ".gltf": MeshFormat(gltf.read_gltf),
}
SUFFIXES = tuple(suffix for suffix, form in FORMATS.items() if form.write is not None)     # that can be written


def read_mesh(path: str | Path) -> Surface:
    """Read a mesh file of one of the kinds in FORMATS."""
    return surface_of(path, read_content(path))


def surface_of(path: str | Path, content: MeshContent) -> Surface:
    """The surface of what was read of `path`; InputError, which names it, where that is none."""
    try:
        return content.surface()
    except InputError as error:
        raise InputError(f"{str(path)!r}: {error}") from error


def read_content(path: str | Path, *, outside: bool = True) -> MeshContent:
    """All that is read of a mesh or point cloud; InputError: damaged, or, without `outside`, naming files out of its
    folder."""
    path = Path(path)
    _check_regular(path)
    form = FORMATS.get(path.suffix.lower())
    if form is None:
        raise InputError(f"mesh {str(path)!r}: unknown kind {path.suffix!r}, expected one of {', '.join(FORMATS)}")
    with translated(f"mesh {str(path)!r} cannot be read: ", damage=(Exception,)):
        return form.read(path, Parts(path, outside))


def _check_regular(path: Path) -> None:
    try:
        kind = stat.S_IFMT(os.stat(path).st_mode)
    except (OSError, ValueError) as error:
        missing = isinstance(error, FileNotFoundError)
        raise InputError(f"mesh {str(path)!r} " + ("does not exist" if missing else f"cannot be read: "
                                                   f"{getattr(error, 'strerror', None) or error}")) from error
    if kind != stat.S_IFREG:
        raise InputError(f"mesh {str(path)!r} is {_KINDS.get(kind, 'no regular file')}, expected a file")


def check_mesh_file(path: str | Path, *, outside: bool = False) -> None:
    """InputError, before pymeshlab opens it, for a mesh file that is damaged, claims more than it holds, has an index
    out of range, is no regular file, or, without `outside`, names files out of its folder; a point cloud is none.

    After our own reader a child process with limits of memory and time loads it, as readers may differ in what they
    take a damaged file for, and of some kinds there is no other check.
    """
    path = Path(path)
    if path.suffix.lower() in FORMATS:
        read_content(path, outside=outside)
    else:
        _check_regular(path)
    size = path.stat().st_size
    answer = child.ask("pagas_cl.scene.meshes.trial", {"path": str(path.absolute())}, _SECONDS + size / _BYTES_A_SECOND)
    reason = answer.fault or answer.value and answer.value["fault"]
    if reason:
        raise InputError(f"mesh {str(path)!r} cannot be loaded by pymeshlab: {reason}; is the file damaged? Write it "
                         "again, as .ply for instance")


def check_mesh_path(path: str | Path) -> Callable[[Path, Surface], None]:
    """What writes a file of this name; InputError where `write_mesh` could not: said before the work, not after it."""
    path = Path(path)
    form = FORMATS.get(path.suffix.lower())
    if form is None or form.write is None:
        raise InputError(f"mesh {str(path)!r}: unknown kind {path.suffix!r}, expected one of {', '.join(SUFFIXES)}")
    if path.is_dir():
        raise InputError(f"mesh {str(path)!r} is a folder, expected a file name")
    return form.write


def check_digits(path: str | Path, surface: Surface, ahead: bool = False) -> None:
    """Raise InputError where the kind of `path` keeps coordinates as float32 and rounding moves vertices by more than
    1 % of the median edge; `ahead` of a refinement, which makes edges shorter, by more than 0.1 %."""
    sides = surface.vertices[surface.faces] - surface.vertices[surface.faces[:, [1, 2, 0]]]
    lengths = np.linalg.norm(sides, axis=2)
    edge = float(np.median(lengths[lengths > 0]))
    _check_rounding(path, surface.vertices, edge, _ROUNDING * (_AHEAD if ahead else 1), "edges are")


def check_digits_of_scene(path: str | Path, centers: np.ndarray) -> None:
    """As `check_digits` of a mesh to be fused of what cameras at `centers` (N, 3) see: by more than a ten-thousandth of
    how far they are from their middle."""
    far = float(np.median(np.linalg.norm(centers - np.median(centers, axis=0), axis=1)))
    if far > 0:
        _check_rounding(path, centers, far, _OF_CAMERAS, "the scene is")


def _check_rounding(path: str | Path, points: np.ndarray, length: float, share: float, what: str) -> None:
    path = Path(path)
    moved = float(np.abs(points - points.astype(np.float32)).max())
    form = FORMATS.get(path.suffix.lower())
    if form is not None and form.single and moved > share * length:
        raise InputError(f"mesh {str(path)!r}: {path.suffix} files keep 7 digits of a coordinate, which would move "
                         f"points at up to {np.abs(points).max():.9g} by {moved:.2g} where {what} {length:.2g} "
                         "long; write .ply, .obj or .off, or move the scene's origin near the mesh")


def write_mesh(path: str | Path, surface: Surface) -> None:
    """Write `surface`, whole or not at all; folders are made. InputError where the kind cannot keep its coordinates."""
    path = Path(path)
    write = check_mesh_path(path)
    check_digits(path, surface)
    with replaced_with_others(path) if path.suffix.lower() == ".obj" else replaced(path) as temporary:
        write(temporary, surface)


def losses(content: MeshContent, output: str | Path) -> list[str]:
    """In words, what a mesh file has and `output` would not have: what its reader does not carry along, and what the
    format of `output` has no place for. Normals are made anew by who reads a file without them."""
    kept = FORMATS[Path(output).suffix.lower()].keeps
    lost = list(content.lost)
    if _NUMBERS not in kept:
        names = [*["quality"] * (content.quality is not None), *content.attributes]
        lost += [f"vertex property {name!r}" for name in names]
    if _COLORS not in kept and content.colors is not None:
        lost.append(_COLORS)
    texture = content.texture
    if _TEXTURE not in kept and texture is not None:
        described = sum(bool(material.statements) for material in texture.library)
        count = described if len(texture.library) == 1 else len(texture.library)
        lost += [f"{count} material" + "s" * (count > 1)] * bool(count)
        lost += [_TEXTURE] * (texture.coordinates is not None)
    return lost
