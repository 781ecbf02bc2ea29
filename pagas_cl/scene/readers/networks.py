"""Depth Anything 3, VGGT, MapAnything: depth, confidence, cameras, small photos as NumPy's arrays, a row a photo.

Convention: z-depth; OpenCV axes; K for the network's image, pixel centres at +0.5. Views are of the photos themselves,
where those are found, else of the network's own small ones. What they write for COLMAP is read as COLMAP (with
`photos=` for the originals where its photos are the network's small ones).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pagas_cl.errors import InputError, log
from pagas_cl.scene import untrusted
from pagas_cl.scene.depth.formats import check_pixels, plane_of
from pagas_cl.scene.depth.placement import Placement, find_placement
from pagas_cl.scene.depth.source import DepthSource, Stored, flat, shape_of, with_least_confidence
from pagas_cl.scene.images import image_size
from pagas_cl.scene.npy_files import ArrayRef, PhotoInArray, members
from pagas_cl.scene.readers import photos as photo_files
from pagas_cl.scene.sampling import evenly
from pagas_cl.scene.view import Scene, View
from pagas_cl.system.files import digest_of

_MOST_ROWS = 100_000
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


def _first(found: Mapping[str, ArrayRef], names: Sequence[str]) -> ArrayRef | None:
    return next((found[name] for name in names if name in found), None)


def _matrices(ref: ArrayRef, *kinds: tuple[int, int]) -> np.ndarray:
    """(N, 3 or 4, 3 or 4) float64, finite; of an array whose last axes are of one of the `kinds`."""
    shape = ref.shape
    known = shape[-2:] in kinds and math.prod(shape[:-2]) <= _MOST_ROWS
    values = np.asarray(ref.load() if known else np.nan, np.float64)
    if not np.isfinite(values).all():
        raise InputError(f"{ref} has shape {shape}, expected a finite matrix a photo of "
                         f"{' or '.join(f'{rows} x {columns}' for rows, columns in kinds)}")
    return values.reshape(-1, *shape[-2:])


def _scene_of(folder: Path, rows: Sequence[Row], named: Path | None, stems: Sequence[str], source: str, *,
              usual: str, least: float | None, camera_to_world: bool = False) -> Scene:
    """The scene: a view of each original photo, else of the network's own; `named`, `stems` as in _find_photos.

    `usual`: how photos come to the network's size where its own photos are not there to compare with; `least`: the
    confidence below which depths are left out, measured where it is None.
    """
    originals = _find_photos(folder, named and Path(named), len(rows), source, stems)
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
    known = dict[tuple[tuple[int, int], tuple[int, int]], Placement]()      # of the first photo of these two sizes
    for k, (row, small) in enumerate(zip(rows, sizes)):
        own = None if row.photo is None else PhotoInArray(row.photo)
        if row.photo is not None:
            check_pixels(row.photo.shape, small, str(row.photo))
        name = originals[k].name if originals else f"{stems[k] if stems else f'{k:06d}'}.png"
        camera = untrusted.pinhole(row.K, row.pose, *small, name, camera_to_world=camera_to_world)
        if originals is None and own is not None:
            views.append(View(camera, own, None, name))
            depths.append(DepthSource(row.depth, small, confidence=row.confidence))
            continue
        photo = (originals or [])[k]
        size = image_size(photo)
        placement = None if own is None or k in compared else known.get((size, small))
        if placement is None:
            placement = find_placement(photo, small, own.load() if own else None, f"{source}, photo {k}", usual)
        known.setdefault((size, small), placement)
        views.append(View(placement.photo_camera(camera, *size), photo, photo_files.find_mask(folder, photo), name))
        depths.append(DepthSource(row.depth, size, placement=placement, confidence=row.confidence))
    depths = with_least_confidence(depths, source, least)
    if originals is None:
        log.info("%s: no photos are next to it: the network's own small ones are used (%d x %d); for all detail name "
                 "the folder of the photos with --photos", source, *depths[0].size)
    else:
        kinds = sorted({placement.kind for depth in depths if (placement := depth.placement) is not None})
        log.info("%s: cameras and depth belong to images of %d x %d (%s); they are scaled to the photos, %d x %d",
                 source, *sizes[0], " and ".join(kinds), *depths[0].size)
    return Scene(views, source, depths=tuple(depths), depth_unit="as the cameras' positions")


def _size(depth: ArrayRef) -> tuple[int, int]:
    height, width = plane_of(shape_of(depth), str(depth))
    return untrusted.size(width, height, str(depth))


def _find_photos(folder: Path, named: Path | None, count: int, source: str, stems: Sequence[str]) -> list[Path] | None:
    """The photos from the folder `named` or next to the export: those called `stems`, where these are there, else
    `count` in the order of their names; None where there are none."""
    if named is not None and not named.is_dir():
        raise InputError(f"photos: {named} is no folder")
    places = [named] if named is not None else [folder / name for name in photo_files.FOLDERS]
    found = [some for place in places if (some := photo_files.list_photos(place))]
    for called in ({path.stem: path for path in some} for some in found):
        if stems and called.keys() >= {*stems}:
            return [called[stem] for stem in stems]
    if not found and named is not None:
        raise InputError(f"photos: {named} holds none ({' '.join(untrusted.IMAGE_SUFFIXES)})")
    return photo_files.one_photo_each(found[0], count, source) if found else None


@dataclass(frozen=True)
class Network:
    """One that leaves all photos, by their sorted paths, in one archive or .npy files of a folder, with world-to-camera
    extrinsics (3, 4). Of the names of arrays, and of places, the first that is there counts.

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
            found = arrays_of(place)
            if _first(found, self.depth) and all(name in found for name in self.marks):
                return place
        return None

    def read(self, folder: Path, place: Path, *, photos: Path | None = None, confidence: float | None = None) -> Scene:
        """Read the predictions; `photos`: folder of the original photos, looked for in images/ and the like by default;
        `confidence`: depths of less are left out, a quarter of the median (see depth.source) by default."""
        found = arrays_of(place)
        depth = _first(found, self.depth)
        absent = [name for name in (self.pose, self.K) if name not in found]
        if depth is None or absent:
            raise InputError(f"{place} has no {[*absent, self.depth[0]][0]!r}: this model gives no cameras; take one "
                             "that does (any-view), or give cameras in another format with the depth maps as "
                             "--depth-dir")
        rows = _rows_of(depth, found[self.pose], found[self.K], found.get(self.confidence), found.get(self.photo))
        source = f"{place if place != folder else folder / depth.file.name} ({self.name})"
        return _scene_of(folder, rows, photos, (), source, usual=self.usual, least=confidence)


def _rows_of(depth: ArrayRef, poses: ArrayRef, K: ArrayRef, confidence: ArrayRef | None,
             photo: ArrayRef | None) -> list[Row]:
    """A Row for each photo, on the first axis, or the second behind a batch of one; InputError unless as many."""
    depth = _without_batch(depth, 2)
    confidence = confidence and _without_batch(confidence, 2)
    photo = photo and _without_batch(photo, 3)
    pose_rows, K_rows = _matrices(poses, (3, 4), (4, 4)), _matrices(K, (3, 3))
    if len(depth.shape) < 3 or not 1 <= (count := depth.shape[0]) <= _MOST_ROWS:
        raise InputError(f"{depth} has shape {depth.shape}, expected (photos, height, width)")
    others = {str(poses): len(pose_rows), str(K): len(K_rows),
              **{str(ref): sum(ref.shape[:1]) for ref in (confidence, photo) if ref is not None}}
    for name, length in others.items():
        if length != count:
            raise InputError(f"{name} has {length} rows and {depth} has {count}, expected one a photo in both")
    return [Row(depth.part(k), pose_rows[k], K_rows[k], confidence and confidence.part(k), photo and photo.part(k))
            for k in range(count)]


def _without_batch(ref: ArrayRef, axes: int) -> ArrayRef:
    """An array of photos, each of `axes` without a channel's: that of the only batch, where there is one."""
    shape = ref.shape
    own = len(shape) - (axes == 2 and shape[-1:] == (1,))
    return ref.part(0) if own > 1 + axes and shape[0] == 1 else ref


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
        return digest_of([f"{self.confidence.digest} {self.mask.digest}".encode()])

    @property
    def shape(self) -> tuple[int, ...]:
        return self.confidence.shape

    def load(self) -> np.ndarray:
        mask, sure = flat(self.mask), flat(self.confidence)
        if mask.shape != sure.shape:
            raise InputError(f"{self.mask} has shape {mask.shape} and {self.confidence} has {sure.shape}, expected one")
        return np.where(mask > 0, sure, np.nan)


def _detect_mapanything(folder: Path) -> list[Path]:
    """The .npz files of the first place where they have depth_z, camera_poses and intrinsics; none without."""
    for name in _PLACES:
        found = sorted((folder / name).glob("[!.]*.npz")) if (folder / name).is_dir() else []
        if found and set(arrays_of(found[0])) >= set(_NEEDED):
            return found
    return []


def _read_mapanything(folder: Path, files: list[Path], *, photos: Path | None = None,
                      confidence: float | None = None) -> Scene:
    """MapAnything's predictions as people keep them: an .npz of its Python output a photo; options as in Network.read.

    `depth_z` (1, h, w, 1), `conf`, `mask` (depths outside it are left out), `camera_poses` (1, 4, 4) camera-to-world,
    `intrinsics`, `img_no_norm` the network's image.
    """
    return _scene_of(folder, [_row(path) for path in files], photos, [path.stem for path in files],
                     f"{files[0].parent} (MapAnything)", usual="cropped", least=confidence, camera_to_world=True)


def _row(path: Path) -> Row:
    found = arrays_of(path)
    absent = [name for name in _NEEDED if name not in found]
    if absent:
        raise InputError(f"{path} has no {absent[0]!r}, expected {', '.join(_NEEDED)}")
    pose, K = _matrices(found["camera_poses"], (4, 4)), _matrices(found["intrinsics"], (3, 3))
    if len(pose) != 1 or len(K) != 1:
        raise InputError(f"{path} holds {len(pose)} camera_poses and {len(K)} intrinsics, expected one of each")
    sure, mask = found.get("conf"), found.get("mask")
    return Row(found["depth_z"], pose[0], K[0], Masked(sure, mask) if sure and mask else sure or mask,
               _first(found, ("img_no_norm", "image")))


MAP_ANYTHING = photo_files.Format(f".npz with {', '.join(_NEEDED)} in {', '.join(_PLACES)}", _detect_mapanything,
                                  _read_mapanything)
