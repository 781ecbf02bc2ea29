"""Depth Anything 3: `exports/npz/results.npz` and its relatives `mini_npz`, `npy`, `mini_npy`.

Convention: z-depth; extrinsics world-to-camera (3, 4), OpenCV; intrinsics for the network's size. No names: the photos'
order is that of their sorted paths. Its COLMAP export is read as COLMAP.
"""

from pathlib import Path

from pagas_cl.errors import InputError
from pagas_cl.scene.readers import predictions
from pagas_cl.scene.view import Scene

PLACES = ("exports/npz/results.npz", "exports/npy", "exports/mini_npz/results.npz", "exports/mini_npy", "results.npz")
_NEEDED = ("depth", "extrinsics", "intrinsics")


def detect(folder: Path) -> Path | None:
    """The first of the exports that is there with its depth, or None."""
    return next((folder / name for name in PLACES if "depth" in predictions.arrays_of(folder / name)), None)


def read(folder: Path, *, photos: Path | None = None, confidence: float | None = None) -> Scene:
    """Read the export; `photos`: folder of the original photos, looked for in images/ and the like by default;
    `confidence`: depths of less are left out, a quarter of the median (see depth_source.least_confidence) by default.
    """
    place = detect(folder)
    if place is None:
        raise InputError(f"{folder} holds no export of Depth Anything 3: looked for {', '.join(PLACES)}")
    found = predictions.arrays_of(place)
    absent = [name for name in _NEEDED if name not in found]
    if absent:
        raise InputError(f"{place} has no {absent[0]!r}: this model gives no cameras; take one that does (any-view), "
                         "or give cameras in another format with the depth maps as --depth-dir")
    rows = predictions.rows_of(found["depth"], found["extrinsics"], found["intrinsics"], found.get("conf"),
                               found.get("image"))
    source = f"{place} (Depth Anything 3)"
    originals = predictions.find_photos(folder, photos and Path(photos), len(rows), source)
    return predictions.scene_of(folder, rows, originals, [f"{k:06d}.png" for k in range(len(rows))], source,
                                least=confidence)
