"""What the readers of mesh files share: what a file holds, numbers written as text, polygons split into triangles."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from pagas_cl.errors import InputError
from pagas_cl.scene.mesh import Surface, Texture
from pagas_cl.scene.own_files import TEXT_MARK

_CHUNK, _LONGEST = 1 << 20, 64   # bytes of text at a time, so that they take little memory; characters of a number
MARK = TEXT_MARK                 # in every mesh file that pagas_cl writes: files.written_by_pagas_cl looks for it
_SPACE = re.compile(rb"\s")
_FIRST_CORNERS = 8               # corners of a polygon that are tried as the one that its triangles share


@dataclass(frozen=True, eq=False)
class MeshContent:
    """A mesh file, parsed: arrays as those of a Surface, whose faces are checked and may be none (a point cloud); and
    in words what else the file holds, which is not carried along."""

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


def has_mark(path: Path) -> bool:
    """Whether one of the first two lines of a file is the mark."""
    with open(path, "rb") as file:
        lines = file.read(len(MARK) + 16).splitlines()[:2]
    return any(line.removeprefix(b"# ").rstrip().startswith(MARK.encode()) for line in lines)


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
    """Triangles of polygons: of each the places (F, 3) of its corners in `corners`, and its polygon (F,), in the order
    of the polygons.

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
    """Faces (F, 3) of polygons as in `polygon_triangles`, their corners checked, and in words the polygons that have no
    area to split."""
    checked = whole(corners, f"{what}: a face names vertex", 0, len(vertices) - 1)
    lines = int((counts < 3).sum())
    lost = (f"{lines} faces of fewer than 3 corners",) if lines else ()
    if (counts == 3).all():
        return checked.reshape(-1, 3), lost
    triangles, _ = polygon_triangles(vertices, checked, counts)
    return checked[triangles], lost


def shares(columns: Sequence[np.ndarray], most: float) -> npt.NDArray[np.float64]:
    """(V, number of columns): what is `most` becomes 1."""
    return np.stack(columns, axis=1).astype(np.float64) / most
