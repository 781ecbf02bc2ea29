"""What phones record: Record3D and Polycam. Poses are camera-to-world with ARKit's (OpenGL) axes, in metres."""

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pagas_cl.errors import InputError, need, short
from pagas_cl.scene import untrusted
from pagas_cl.scene.camera import FLIP, intrinsics
from pagas_cl.scene.readers import photos
from pagas_cl.scene.readers.recordings import Frame, by_number, scene_of
from pagas_cl.scene.view import Scene
from pagas_cl.system.files import digest_file, translated

_METADATA = ("metadata", "metadata.json")
_PLACES = ("rgbd", "rgb", "color", "images")
_RECORD3D = ("w", "h", "dw", "dh", "K", "poses", "perFrameIntrinsicCoeffs")
_POLYCAM = ("fx", "fy", "cx", "cy", "width", "height", *(f"t_{r}{c}" for r in range(3) for c in range(4)))
_KINDS = (("corrected_cameras", "corrected_images"), ("cameras", "images"))


@dataclass(frozen=True)
class Packed:
    """A map (height, width) packed by LZFSE."""

    file: Path
    shape: tuple[int, int]
    dtype: str

    def __str__(self) -> str:
        return str(self.file)

    @property
    def digest(self) -> str:
        return f"{digest_file(self.file)} {self.shape} {self.dtype}"

    def load(self) -> np.ndarray:
        """The numbers; blocks that are not compressed are read here, others by the package liblzfse."""
        with translated(f"{self.file} cannot be read: ", "; is the file damaged?"):
            data, size = untrusted.read_bytes(self.file), np.dtype(self.dtype).itemsize * self.shape[0] * self.shape[1]
            raw = _stored(data)
            if raw is None:
                raw = need("liblzfse", "record3d", f"reading {self.file} (or export EXR)").decompress(data)
            if len(raw) != size:
                raise ValueError(f"it holds {len(raw)} bytes, expected {size} for {self.shape[1]} x {self.shape[0]}")
            return np.frombuffer(raw, self.dtype).reshape(self.shape)


def _stored(data: bytes) -> bytes | None:
    """The content of a stream whose blocks are all stored as they are; None where one is compressed."""
    parts, place = [], 0
    while data[place:place + 4] == b"bvx-":
        (count,) = struct.unpack_from("<I", data, place + 4)
        parts.append(data[place + 8:place + 8 + count])
        place += 8 + count
    return b"".join(parts) if parts and data[place:place + 4] == b"bvx$" else None


def _detect_record3d(folder: Path) -> Path | None:
    path = photos.first_file(folder, _METADATA)
    return path if path and untrusted.holds(path, b'"poses"') else None


def _read_record3d(folder: Path, path: Path) -> Scene:
    """`metadata` (or .json) with `rgbd/N.jpg`, `N.depth`, `N.conf` (an unpacked .r3d), or `rgb/`, `depth/N.exr`.

    Poses are qx qy qz qw tx ty tz; K is column by column, for photos of w x h, or fx fy cx cy a frame; .depth is
    float32 metres and .conf 8 bit (0 low, 2 high), both packed by LZFSE.
    """
    data = untrusted.read_json(path)
    untrusted.refuse_near_misses(data, _RECORD3D, str(path))
    numbered = by_number(photos.scene_photos(folder, _PLACES))
    poses = data.get("poses")
    if not isinstance(poses, list) or len(poses) != len(numbered):
        raise InputError(f"{path} has {len(poses) if isinstance(poses, list) else 'no'} poses and "
                         f"{numbered[0].parent} has {len(numbered)} photos, expected as many")
    frames = [_frame_of_record3d(folder, data, k, photo, f"{path}, frame {k}") for k, photo in enumerate(numbered)]
    return scene_of(folder, frames, f"{path} (Record3D)", 1.0, "metres, as the format says")


def _frame_of_record3d(folder: Path, data: dict[str, Any], k: int, photo: Path, where: str) -> Frame:
    numbers = untrusted.numbers(data["poses"][k], 7, f"{where}: pose")
    pose = untrusted.pose(numbers[:4], numbers[4:], where) @ FLIP
    each = data.get("perFrameIntrinsicCoeffs")
    if each:
        if not isinstance(each, list) or len(each) != len(data["poses"]):
            raise InputError(f"{where}: perFrameIntrinsicCoeffs is {short(each)}, expected four numbers for each of "
                             f"the {len(data['poses'])} poses, or nothing")
        K = intrinsics(*untrusted.numbers(each[k], 4, f"{where}: perFrameIntrinsicCoeffs"))
    else:
        K = untrusted.numbers(data.get("K"), 9, f"{where}: K").reshape(3, 3).T
    (width, height), said = photos.photo_size(photo), untrusted.size(data.get("w"), data.get("h"), where)
    if abs(width / said[0] - height / said[1]) > 0.02:
        raise InputError(f"{where}: w and h are {said[0]} x {said[1]} and {photo.name} is {width} x {height}, of "
                         "another shape: is it turned?")
    K = np.diag([width / said[0], height / said[1], 1.0]) @ K
    depth = photos.first_file(folder, (f"depth/{photo.stem}.exr", f"rgbd/{photo.stem}.exr"))
    packed, sure = photo.with_suffix(".depth"), photo.with_suffix(".conf")
    if depth is not None or not packed.is_file():
        return Frame(photo, pose, K, depth)
    size = untrusted.size(data.get("dw", 192), data.get("dh", 256), f"{where}: depth")[::-1]
    return Frame(photo, pose, K, Packed(packed, size, "<f4"), Packed(sure, size, "u1") if sure.is_file() else None)


def _detect_polycam(folder: Path) -> tuple[Path, Path] | None:
    """The folders of Polycam's cameras and of their photos."""
    root = folder / "keyframes" if (folder / "keyframes").is_dir() else folder
    for cameras, images in _KINDS:
        first = min((root / cameras).glob("[!.]*.json"), default=None)
        if first is not None and photos.list_photos(root / images) and untrusted.holds(first, b'"t_00"'):
            return root / cameras, root / images
    return None


def _read_polycam(folder: Path, place: tuple[Path, Path]) -> Scene:
    """Polycam's raw data: `keyframes/images`, `cameras`, `depth`, `confidence`; where they are there the `corrected_`
    images and cameras, which Polycam adjusted.

    t_00 to t_23 are the first three rows of the pose; depth is z-depth in millimetres, smaller than the photo and
    covering the same; confidence 0 is low.
    """
    cameras, images = place
    frames = [_frame_of_polycam(images, path) for path in sorted(cameras.glob("[!.]*.json"))]
    return scene_of(folder, frames, f"{cameras} (Polycam)", 1000.0, "millimetres, as the format says")


def _frame_of_polycam(images: Path, path: Path) -> Frame:
    data = untrusted.read_json(path)
    untrusted.refuse_near_misses(data, _POLYCAM, str(path))
    number = {key: untrusted.number(data.get(key), f"{path}: {key}") for key in _POLYCAM}
    photo = photos.first_file(images, (path.stem + suffix for suffix in untrusted.IMAGE_SUFFIXES))
    if photo is None:
        raise InputError(f"{path}: its photo {path.stem}.jpg is missing in {images}")
    size, said = photos.photo_size(photo), untrusted.size(number["width"], number["height"], str(path))
    if size != said:
        raise InputError(f"{path} says {said[0]} x {said[1]} and {photo.name} is {size[0]} x {size[1]}")
    pose = np.vstack([[[number[f"t_{r}{c}"] for c in range(4)] for r in range(3)], [0, 0, 0, 1]])
    return Frame(photo, pose @ FLIP, intrinsics(*(number[key] for key in ("fx", "fy", "cx", "cy"))),
                 photos.first_file(images.parent, (f"depth/{path.stem}.png",)),
                 photos.first_file(images.parent, (f"confidence/{path.stem}.png",)))


RECORD3D = photos.Format(f"{' or '.join(_METADATA)} with poses: unpack the .r3d (it is a zip archive)",
                         _detect_record3d, _read_record3d)
POLYCAM = photos.Format("cameras/*.json of Polycam with images/: export raw data (Polycam's developer mode)",
                        _detect_polycam, _read_polycam)
