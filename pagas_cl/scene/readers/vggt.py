"""VGGT's predictions as people keep them: `predictions.npz`, or .npy files, with depth, confidence and cameras.

Convention: depth (`depth_map` or `depth`, (S, h, w, 1)) is z-depth; `extrinsic` (S, 3, 4) world-to-camera, OpenCV;
`intrinsic` for the network's image: a square that the photo was padded to, or 518 wide. Its demo_colmap.py writes a
COLMAP model, which is read as COLMAP, and no depth.
"""

from pathlib import Path

from pagas_cl.errors import InputError
from pagas_cl.scene.readers import predictions
from pagas_cl.scene.view import Scene

PLACES = ("predictions.npz", "vggt.npz", "vggt", ".")
_DEPTH, _POSE, _K = ("depth_map", "depth"), ("extrinsic",), ("intrinsic",)
_CONFIDENCE, _PHOTO = ("depth_conf",), ("images",)


def detect(folder: Path) -> Path | None:
    """The first place where depth, extrinsic and intrinsic are together, or None."""
    for name in PLACES:
        found = predictions.arrays_of(folder / name)
        if all(predictions.first(found, names) for names in (_DEPTH, _POSE, _K)):
            return folder / name
    return None


def read(folder: Path, *, photos: Path | None = None, confidence: float | None = None) -> Scene:
    """Read the predictions; options as in depth_anything.read."""
    place = detect(folder)
    if place is None:
        raise InputError(f"{folder} holds no predictions of VGGT: looked for depth_map (or depth), extrinsic and "
                         f"intrinsic in {', '.join(PLACES)}")
    found = predictions.arrays_of(place)
    depth, pose, K, sure, photo = (predictions.first(found, names) for names in
                                   (_DEPTH, _POSE, _K, _CONFIDENCE, _PHOTO))
    if depth is None or pose is None or K is None:
        raise InputError(f"{place} has changed while it was read")
    rows = predictions.rows_of(depth, pose, K, sure, photo)
    source = f"{place if place != folder else folder / depth.file.name} (VGGT)"
    originals = predictions.find_photos(folder, photos and Path(photos), len(rows), source)
    return predictions.scene_of(folder, rows, originals, [f"{k:06d}.png" for k in range(len(rows))], source,
                                usual="padded", least=confidence)
