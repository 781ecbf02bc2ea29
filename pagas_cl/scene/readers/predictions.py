"""What feed-forward networks leave: depth, confidence, cameras and their small photos as arrays, a row a photo.

Convention: z-depth; OpenCV axes; K for the network's image, pixel centres at +0.5. The readers of single networks
(networks.py) say where the arrays are and how photos came to the network's size; here they become views of the photos
themselves, where those are found, else of the network's own small ones.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pagas_cl.errors import InputError, log
from pagas_cl.scene import untrusted
from pagas_cl.scene.depth.formats import check_pixels, plane_of
from pagas_cl.scene.depth.placement import Placement, find_placement
from pagas_cl.scene.depth.source import DepthSource, Stored, shape_of, with_least_confidence
from pagas_cl.scene.images import image_size
from pagas_cl.scene.npy_files import ArrayRef, PhotoInArray, members
from pagas_cl.scene.readers import photos
from pagas_cl.scene.sampling import evenly
from pagas_cl.scene.view import Scene, View

MOST_ROWS = 100_000
_COMPARED = 3       # photos that are compared with the network's
_OFF = 0.25         # of the network's image: no principal point of its own is nearer to a border


@dataclass(frozen=True)
class Row:
    """One photo's arrays: `pose` (3 or 4, 4) and K as they are in the file."""

    depth: ArrayRef
    pose: np.ndarray
    K: np.ndarray
    confidence: Stored | None = None
    photo: ArrayRef | None = None


def arrays_of(place: Path) -> dict[str, ArrayRef]:
    """Arrays by name: members of an .npz, or the .npy files of a folder."""
    if place.is_dir():
        return {path.stem: ArrayRef(path) for path in sorted(place.glob("*.npy"))}
    return {name: ArrayRef(place, name) for name in members(place)}


def first(found: Mapping[str, ArrayRef], names: Sequence[str]) -> ArrayRef | None:
    """The first of `names` that is there."""
    return next((found[name] for name in names if name in found), None)


def rows_of(depth: ArrayRef, poses: ArrayRef, K: ArrayRef, confidence: ArrayRef | None,
            photo: ArrayRef | None) -> list[Row]:
    """A Row for each photo, whose axis is the first, or the second behind a batch of one; InputError where the arrays
    are not of one length."""
    depth = _without_batch(depth, 2)
    confidence = confidence and _without_batch(confidence, 2)
    photo = photo and _without_batch(photo, 3)
    pose_rows = matrices(poses, (3, 4), (4, 4))
    K_rows = matrices(K, (3, 3))
    if len(depth.shape) < 3 or not 1 <= (count := depth.shape[0]) <= MOST_ROWS:
        raise InputError(f"{depth} has shape {depth.shape}, expected (photos, height, width)")
    others = {str(poses): len(pose_rows), str(K): len(K_rows),
              **{str(ref): sum(ref.shape[:1]) for ref in (confidence, photo) if ref is not None}}
    for name, length in others.items():
        if length != count:
            raise InputError(f"{name} has {length} rows and {depth} has {count}, expected one a photo in both")
    return [Row(depth.part(k), pose_rows[k], K_rows[k], confidence and confidence.part(k), photo and photo.part(k))
            for k in range(count)]


def _without_batch(ref: ArrayRef, axes: int) -> ArrayRef:
    """Of an array with the axes of photos and `axes` of each, a channel's apart: that of the only batch, where there is
    one."""
    shape = ref.shape
    own = len(shape) - (axes == 2 and shape[-1:] == (1,))
    return ref.part(0) if own > 1 + axes and shape[0] == 1 else ref


def matrices(ref: ArrayRef, *kinds: tuple[int, int]) -> np.ndarray:
    """(N, 3 or 4, 3 or 4) float64, finite; of an array whose last axes are of one of the `kinds`."""
    shape = ref.shape
    known = shape[-2:] in kinds and math.prod(shape[:-2]) <= MOST_ROWS
    values = np.asarray(ref.load() if known else np.nan, np.float64)
    if not np.isfinite(values).all():
        raise InputError(f"{ref} has shape {shape}, expected a finite matrix a photo of "
                         f"{' or '.join(f'{rows} x {columns}' for rows, columns in kinds)}")
    return values.reshape(-1, *shape[-2:])


def scene_of(folder: Path, rows: Sequence[Row], originals: Sequence[Path] | None, names: Sequence[str], source: str, *,
             usual: str = "stretched", camera_to_world: bool = False, least: float | None = None) -> Scene:
    """The scene: a view of each original photo, or of the network's own (called `names`) where there are none.

    `usual`: how photos come to the network's size where its own photos are not there to compare with; `least`: the
    confidence below which depths are left out, measured where it is None.
    """
    if originals is None and any(row.photo is None for row in rows):
        raise InputError(f"{source} holds no photos, and none were found: put them into images/ next to it, under "
                         "names in the order that the network had them, or name their folder (--photos DIR)")
    sizes = [_size(row.depth) for row in rows]
    places = np.array([row.K[:2, 2] for row in rows]) / sizes
    if places.min() > 1 - _OFF or places.max() < _OFF:
        (x, y), (width, height) = np.median(places, axis=0), sizes[0]
        raise InputError(f"{source}: principal points lie at {x:.2f}, {y:.2f} of the network's images "
                         f"({width} x {height}), not near their middle: the intrinsics belong to images of another "
                         "size; scale them to that of the depth maps")
    compared = set(evenly(len(rows), _COMPARED).tolist())
    views, depths = list[View](), list[DepthSource]()
    known: dict[Any, Placement] = {}        # of the first photo of these sizes, its own and the network's
    for k, row in enumerate(rows):
        where = f"{source}, photo {k}"
        small = sizes[k]
        own = None if row.photo is None else PhotoInArray(row.photo)
        if row.photo is not None:
            check_pixels(row.photo.shape, small, str(row.photo))
        name = names[k] if originals is None else originals[k].name
        camera = untrusted.pinhole(row.K, row.pose, *small, name, camera_to_world=camera_to_world)
        if originals is None and own is not None:
            views.append(View(camera, own, None, name))
            depths.append(DepthSource(row.depth, small, confidence=row.confidence))
            continue
        photo = (originals or [])[k]
        width, height = image_size(photo)
        placement = None if own is None or k in compared else known.get(((width, height), small))
        if placement is None:
            placement = find_placement(photo, small, own.load() if own else None, where, usual)
        known.setdefault(((width, height), small), placement)
        views.append(View(placement.photo_camera(camera, width, height), photo, photos.find_mask(folder, photo), name))
        depths.append(DepthSource(row.depth, (width, height), placement=placement, confidence=row.confidence))
    depths = with_least_confidence(depths, source, least)
    _log_sizes(depths, originals is None, source)
    return Scene(views, source, depths=tuple(depths), depth_unit="as the cameras' positions")


def _size(depth: Path | Stored) -> tuple[int, int]:
    """Width and height of a depth map."""
    height, width = plane_of(shape_of(depth), str(depth))
    return untrusted.size(width, height, str(depth))


def _log_sizes(depths: list[DepthSource], own: bool, source: str) -> None:
    kinds = sorted({depth.placement.kind for depth in depths if depth.placement is not None})
    if own:
        log.info("%s: no photos are next to it: the network's own small ones are used (%d x %d); for all detail name "
                 "the folder of the photos with --photos", source, *depths[0].size)
    else:
        log.info("%s: cameras and depth belong to images of %d x %d (%s); they are scaled to the photos, %d x %d",
                 source, *_size(depths[0].file), " and ".join(kinds), *depths[0].size)


def find_photos(folder: Path, named: Path | None, count: int, source: str,
                stems: Sequence[str] = ()) -> list[Path] | None:
    """The photos from the folder `named` or next to the export: those called `stems`, where these are there, else
    `count` in the order of their names; None where there are none."""
    if named is not None and not named.is_dir():
        raise InputError(f"photos: {named} is no folder")
    places = [named] if named is not None else [folder / name for name in photos.FOLDERS]
    found = [some for place in places if (some := photos.list_photos(place))]
    for called in ({path.stem: path for path in some} for some in found):
        if stems and called.keys() >= {*stems}:
            return [called[stem] for stem in stems]
    if not found and named is not None:
        raise InputError(f"photos: {named} holds none ({' '.join(untrusted.IMAGE_SUFFIXES)})")
    return photos.one_photo_each(found[0], count, source) if found else None
