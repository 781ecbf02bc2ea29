"""MapAnything's predictions as people keep them: an .npz a view, with the arrays of its Python output.

Convention: `depth_z` (1, h, w, 1) z-depth, `conf`, `mask` (depths outside it are left out), `camera_poses` (1, 4, 4)
camera-to-world, OpenCV, `intrinsics` for the network's image, `img_no_norm` that image. A file belongs to the photo of
its name. Its COLMAP export, whose photos are the network's small ones, is read as COLMAP (with `photos=` for the
originals).
"""

import math
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

PLACES = ("predictions", "mapanything", ".")
_NEEDED = {"depth_z", "camera_poses", "intrinsics"}
EXPECTED = f".npz with {', '.join(sorted(_NEEDED))} in {', '.join(PLACES)}"


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


def detect(folder: Path) -> list[Path]:
    """The .npz files of the first place where they have depth_z, camera_poses and intrinsics; none without."""
    for name in PLACES:
        found = sorted((folder / name).glob("*.npz")) if (folder / name).is_dir() else []
        if found and set(predictions.arrays_of(found[0])) >= _NEEDED:
            return found
    return []


def read(folder: Path, files: list[Path], *, photos: Path | None = None, confidence: float | None = None) -> Scene:
    """Read the predictions; options as in networks.Network.read."""
    rows = [_row(path) for path in files]
    source = f"{files[0].parent} (MapAnything)"
    originals = _originals(folder, photos and Path(photos), files, source)
    return predictions.scene_of(folder, rows, originals, [f"{path.stem}.png" for path in files], source,
                                usual="cropped", camera_to_world=True, least=confidence)


def _row(path: Path) -> predictions.Row:
    found = predictions.arrays_of(path)
    absent = _NEEDED - set(found)
    if absent:
        raise InputError(f"{path} has no {min(absent)!r}, expected {', '.join(sorted(_NEEDED))}")
    pose, K = (_square(found[name], side) for name, side in (("camera_poses", 4), ("intrinsics", 3)))
    sure, mask = found.get("conf"), found.get("mask")
    return predictions.Row(found["depth_z"], pose, K, Masked(sure, mask) if sure and mask else sure or mask,
                           predictions.first(found, ("img_no_norm", "image")))


def _square(ref: ArrayRef, side: int) -> np.ndarray:
    known = math.prod(ref.shape) == side * side
    values = np.asarray(ref.load() if known else np.nan, np.float64)
    if not np.isfinite(values).all():
        raise InputError(f"{ref} has shape {ref.shape}, expected one finite matrix of {side} x {side}")
    return values.reshape(side, side)


def _originals(folder: Path, named: Path | None, files: list[Path], source: str) -> list[Path] | None:
    """By name where the files are called as the photos are, else in order."""
    for place in [named] if named is not None else [folder / name for name in photo_files.FOLDERS]:
        by_stem = {path.stem: path for path in photo_files.list_photos(place)}
        if by_stem and all(path.stem in by_stem for path in files):
            return [by_stem[path.stem] for path in files]
    return predictions.find_photos(folder, named, len(files), source)
