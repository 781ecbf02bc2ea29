"""Depth Anything 3, VGGT and MapAnything: what they leave of the photos of a scene as NumPy's arrays.

Convention: z-depth; OpenCV axes; intrinsics for the network's image. What they write for COLMAP is read as COLMAP (with
`photos=` for the originals where its photos are the network's small ones).
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pagas_cl.errors import InputError
from pagas_cl.scene.depth.source import flat
from pagas_cl.scene.npy_files import ArrayRef
from pagas_cl.scene.readers import photos as photo_files
from pagas_cl.scene.readers import predictions
from pagas_cl.scene.view import Scene
from pagas_cl.system.files import digest_of


@dataclass(frozen=True)
class Network:
    """One that leaves all photos, in the order of their sorted paths, in one archive or in .npy files of one folder,
    with world-to-camera extrinsics (3, 4): what it calls its arrays and where it leaves them. The first name, and the
    first place, that is there counts.

    `marks`: the arrays by which a place is recognized; `usual`: how photos come to the network's size.
    """

    name: str
    places: tuple[str, ...]
    depth: tuple[str, ...]
    pose: str
    K: str
    confidence: str
    photo: str
    marks: tuple[str, ...]
    usual: str

    @property
    def EXPECTED(self) -> str:
        return f"predictions of {self.name}: looked for {', '.join(self.marks)} in {', '.join(self.places)}"

    def detect(self, folder: Path) -> Path | None:
        """The first place that has depth and the marks."""
        for place in (folder / name for name in self.places):
            found = predictions.arrays_of(place)
            if predictions.first(found, self.depth) and all(name in found for name in self.marks):
                return place
        return None

    def read(self, folder: Path, place: Path, *, photos: Path | None = None, confidence: float | None = None) -> Scene:
        """Read the predictions; `photos`: folder of the original photos, looked for in images/ and the like by default;
        `confidence`: depths of less are left out, a quarter of the median (see depth.source) by default."""
        found = predictions.arrays_of(place)
        depth = predictions.first(found, self.depth)
        absent = [name for name in (self.pose, self.K) if name not in found]
        if depth is None or absent:
            raise InputError(f"{place} has no {[*absent, self.depth[0]][0]!r}: this model gives no cameras; take one "
                             "that does (any-view), or give cameras in another format with the depth maps as "
                             "--depth-dir")
        rows = predictions.rows_of(depth, found[self.pose], found[self.K], found.get(self.confidence),
                                   found.get(self.photo))
        source = f"{place if place != folder else folder / depth.file.name} ({self.name})"
        originals = predictions.find_photos(folder, photos and Path(photos), len(rows), source)
        return predictions.scene_of(folder, rows, originals, [f"{k:06d}.png" for k in range(len(rows))], source,
                                    usual=self.usual, least=confidence)


DEPTH_ANYTHING = Network(
    "Depth Anything 3",
    ("exports/npz/results.npz", "exports/npy", "exports/mini_npz/results.npz", "exports/mini_npy", "results.npz"),
    depth=("depth",), pose="extrinsics", K="intrinsics", confidence="conf", photo="image", marks=("depth",),
    usual="stretched")
# as people keep them: its demonstration writes a COLMAP model and no depth; photos are padded to a square, or 518 wide
VGGT = Network(
    "VGGT", ("predictions.npz", "vggt.npz", "vggt", "."), depth=("depth_map", "depth"), pose="extrinsic", K="intrinsic",
    confidence="depth_conf", photo="images", marks=("extrinsic", "intrinsic"), usual="padded")


_PLACES = ("predictions", "mapanything", ".")
_NEEDED = ("camera_poses", "depth_z", "intrinsics")


@dataclass(frozen=True)
class Masked:
    """Confidence, NaN outside the network's mask (of what it takes for no surface, and of edges)."""

    confidence: ArrayRef
    mask: ArrayRef

    def __str__(self) -> str:
        return str(self.confidence)

    @property
    def digest(self) -> str:
        """Of both."""
        return digest_of([f"{self.confidence.digest} {self.mask.digest}".encode()])

    @property
    def shape(self) -> tuple[int, ...]:
        """Of the confidence, by the file's header."""
        return self.confidence.shape

    def load(self) -> np.ndarray:
        """(h, w) float; InputError where the file is damaged."""
        mask, sure = flat(self.mask), flat(self.confidence)
        if mask.shape != sure.shape:
            raise InputError(f"{self.mask} has shape {mask.shape} and {self.confidence} has {sure.shape}, expected one")
        return np.where(mask > 0, sure, np.nan)


def _detect_mapanything(folder: Path) -> list[Path]:
    """The .npz files of the first place where they have depth_z, camera_poses and intrinsics; none without."""
    for name in _PLACES:
        found = sorted((folder / name).glob("[!.]*.npz")) if (folder / name).is_dir() else []
        if found and set(predictions.arrays_of(found[0])) >= set(_NEEDED):
            return found
    return []


def _read_mapanything(folder: Path, files: list[Path], *, photos: Path | None = None,
                      confidence: float | None = None) -> Scene:
    """MapAnything's predictions as people keep them: an .npz a view, with the arrays of its Python output, of the photo
    of its name; options as in Network.read.

    `depth_z` (1, h, w, 1), `conf`, `mask` (depths outside it are left out), `camera_poses` (1, 4, 4) camera-to-world,
    `intrinsics`, `img_no_norm` the network's image.
    """
    rows = [_row(path) for path in files]
    source = f"{files[0].parent} (MapAnything)"
    originals = predictions.find_photos(folder, photos and Path(photos), len(files), source,
                                        [path.stem for path in files])
    return predictions.scene_of(folder, rows, originals, [f"{path.stem}.png" for path in files], source,
                                usual="cropped", camera_to_world=True, least=confidence)


def _row(path: Path) -> predictions.Row:
    found = predictions.arrays_of(path)
    absent = [name for name in _NEEDED if name not in found]
    if absent:
        raise InputError(f"{path} has no {absent[0]!r}, expected {', '.join(_NEEDED)}")
    pose, K = predictions.matrices(found["camera_poses"], (4, 4)), predictions.matrices(found["intrinsics"], (3, 3))
    if len(pose) != 1 or len(K) != 1:
        raise InputError(f"{path} holds {len(pose)} camera_poses and {len(K)} intrinsics, expected one of each")
    sure, mask = found.get("conf"), found.get("mask")
    return predictions.Row(found["depth_z"], pose[0], K[0], Masked(sure, mask) if sure and mask else sure or mask,
                           predictions.first(found, ("img_no_norm", "image")))


MAP_ANYTHING = photo_files.Format(f".npz with {', '.join(_NEEDED)} in {', '.join(_PLACES)}", _detect_mapanything,
                                  _read_mapanything)
