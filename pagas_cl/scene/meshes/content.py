"""What the readers of mesh files share: content, files that they name, numbers as text, polygons as triangles."""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from os.path import exists, isdir, isfile
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import numpy.typing as npt

from pagas_cl.errors import InputError
from pagas_cl.scene.mesh import Surface, Texture
from pagas_cl.scene.untrusted import inside, read_bytes

_CHUNK, _LONGEST = 1 << 20, 64   # bytes of text at a time, so that they take little memory; characters of a number
_MOST_BYTES = 1 << 30            # of a file that a mesh file names
_MOST_FIELDS = 64                # of a line that names files: options of a texture are 20 or fewer
_SPACE = re.compile(rb"\s")
_FIRST_CORNERS = 8               # corners of a polygon that are tried as the one that its triangles share


@dataclass(frozen=True, eq=False)
class MeshContent:
    """A mesh file, parsed: as a Surface, perhaps without faces (a point cloud); in words what is not carried on."""

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None = None
    colors: np.ndarray | None = None
    quality: np.ndarray | None = None
    attributes: dict[str, np.ndarray] = field(default_factory=dict)
    texture: Texture | None = None
    lost: tuple[str, ...] = ()

    def surface(self) -> Surface:
        """InputError where there are no triangles or vertices are not finite."""
        return Surface(self.vertices, self.faces, self.normals, self.colors, self.quality, self.attributes,
                       self.texture)


@dataclass(frozen=True)
class Parts:
    """What the file `mesh` may name and read besides itself (materials, textures, buffers): regular files, since a pipe
    would be waited for, in its folder, since a foreign file must not choose what is read, or, `outside`, anywhere."""

    mesh: Path
    outside: bool = True

    def check(self, line: str) -> list[tuple[str, Path]]:
        """Names and files that may be meant by `line`, the end of a line: options may stand before a name, several of
        them on a line, or spaces in one; the longest name first, and none that is not there.

        InputError where one is a pipe, a device or the like, too large, or leads out of the mesh's folder.
        """
        return [(name, path) for name in dict.fromkeys(_names(line)) for path in self._file(name)]

    def read_uri(self, uri: str) -> bytes:
        """Content of the file that a uri names; as `check`, and an InputError where there is none."""
        found = self.check(unquote(uri))
        if not found:
            raise InputError(f"mesh {str(self.mesh)!r} names the file {uri[:200]!r}, which is not there")
        return read_bytes(found[0][1], _MOST_BYTES)

    def _file(self, name: str) -> Iterator[Path]:
        what = f"mesh {str(self.mesh)!r}"
        found = self.mesh.parent / name.replace("\\", "/")
        if not exists(found) or isdir(found):       # or no name that a file can have
            return
        path = inside(self.mesh.parent, name, f"{what}: a file that it names", outside=self.outside)
        try:
            read_bytes(path, _MOST_BYTES)
        except InputError as error:
            raise InputError(f"{what}: {error}") from error
        if isfile(path):
            yield path


def _names(line: str) -> Iterator[str]:
    """Ends of a line that begin with a field, and its fields."""
    fields = line.split()[:_MOST_FIELDS]
    rest = line.strip()
    for word in fields:
        rest = rest[rest.index(word):]
        yield rest
        rest = rest[len(word):]
    yield from fields


def numbers(text: bytes) -> npt.NDArray[np.float64]:
    """All numbers of a text, separated by white space; ValueError where something else is in it."""
    parts, start = [np.empty(0)], 0
    while start < len(text):
        end = _SPACE.search(text, start + _CHUNK)
        stop = end.start() if end else len(text)
        tokens = text[start:stop].split()
        # NumPy gives every token the room of the longest one, and takes "1_0" for a number
        if tokens and (max(map(len, tokens)) > _LONGEST or b"_" in text[start:stop]):
            raise ValueError("it holds text where numbers are expected")
        parts.append(np.array(tokens, np.bytes_).astype(np.float64) if tokens else np.empty(0))
        start = stop
    return np.concatenate(parts)


def whole(values: np.ndarray, what: str, least: int, most: int) -> npt.NDArray[np.int64]:
    """`values` as whole numbers from `least` to `most`; InputError for any other number, which says `what` it is."""
    good = (values >= least) & (values <= most)
    if values.dtype.kind == "f":
        good &= values == np.rint(values)
    if not good.all():
        bad = values[np.argmin(good)]
        expected = f"whole numbers from {least} to {most}" if most >= least else "none, as there is nothing to name"
        raise InputError(f"{what} {bad:g} among {len(values)}, expected {expected}: is the file damaged?")
    return values.astype(np.int64)


def polygon_triangles(vertices: np.ndarray, corners: np.ndarray, counts: np.ndarray
                      ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Triangles of polygons: the places (F, 3) of their corners in `corners`, and their polygons (F,), in order.

    `corners` are the vertices of all polygons, one polygon after the other, `counts` how many each of them has. The
    triangles of a polygon share a corner: the first one, unless a triangle would turn over there (the polygon is not
    convex) and none does, or less far, around one of the next corners. Polygons of two corners or fewer have none.
    """
    starts = np.cumsum(counts) - counts
    triangles, owners = [np.empty((0, 3), np.int64)], [np.empty(0, np.int64)]
    for count in np.unique(counts[counts >= 3]).tolist():
        polygons = np.flatnonzero(counts == count)
        ring = starts[polygons, None] + np.arange(count)
        if count > 3:
            shared = _shared_corner(vertices[corners[ring]])
            ring = starts[polygons, None] + (shared[:, None] + np.arange(count)) % count
        first = np.broadcast_to(ring[:, :1], (len(ring), count - 2))
        triangles.append(np.stack([first, ring[:, 1:-1], ring[:, 2:]], axis=2).reshape(-1, 3))
        owners.append(np.repeat(polygons, count - 2))
    owner = np.concatenate(owners)
    order = np.argsort(owner, kind="stable")
    return np.concatenate(triangles)[order], owner[order]


def _shared_corner(points: np.ndarray) -> npt.NDArray[np.int64]:
    """Which corner (N,) the triangles of each polygon share; `points` are its corners (N, corners, 3)."""
    best, shared = np.full(len(points), -np.inf), np.zeros(len(points), np.int64)
    with np.errstate(all="ignore"):      # corners may be anywhere
        for turn in range(min(points.shape[1], _FIRST_CORNERS)):
            sides = np.roll(points, -turn, axis=1)[:, 1:] - points[:, turn:turn + 1]
            areas = np.cross(sides[:, :-1], sides[:, 1:])
            flattest = (areas * areas.sum(axis=1, keepdims=True)).sum(axis=2).min(axis=1)
            better = (best <= 0) & (flattest > best)
            best[better] = flattest[better]
            shared[better] = turn
            if (best > 0).all():
                break
    return shared


def text_of_line(line: bytes) -> str:
    """Text of a file whose encoding is not known; encoded in the same way it is the same bytes."""
    return line.decode("utf-8", "surrogateescape")


def split_corners(vertices: np.ndarray, corners: np.ndarray, counts: np.ndarray, what: str
                  ) -> tuple[np.ndarray, tuple[str, ...]]:
    """Faces (F, 3) of polygons as in `polygon_triangles`, corners checked; in words those that have no area."""
    checked = whole(corners, f"{what}: a face names vertex", 0, len(vertices) - 1)
    lines = int((counts < 3).sum())
    lost = (f"{lines} faces of fewer than 3 corners",) if lines else ()
    if (counts == 3).all():
        return checked.reshape(-1, 3), lost
    triangles, _ = polygon_triangles(vertices, checked, counts)
    return checked[triangles], lost
