"""Record3D: `metadata` (or `metadata.json`) with `rgbd/N.jpg`, `N.depth`, `N.conf` (an unpacked .r3d), or with `rgb/`
and `depth/N.exr`.

Convention: poses are qx qy qz qw tx ty tz, camera-to-world, ARKit's (OpenGL) axes, metres; K column by column, for
photos of w x h, or fx fy cx cy a frame; .depth is float32 metres and .conf 8 bit (0 low, 2 high), both packed by LZFSE.
"""

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pagas_cl.errors import InputError, need, short
from pagas_cl.scene import untrusted
from pagas_cl.scene.camera import FLIP, intrinsics
from pagas_cl.scene.readers import photos, rgbd
from pagas_cl.scene.view import Scene
from pagas_cl.system.files import digest_file, translated

NAMES = ("metadata", "metadata.json")
EXPECTED = f"{' or '.join(NAMES)} with poses: unpack the .r3d (it is a zip archive)"
_PLACES = ("rgbd", "rgb", "color", "images")
_KNOWN = ("w", "h", "dw", "dh", "K", "poses", "perFrameIntrinsicCoeffs")


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


def detect(folder: Path) -> Path | None:
    """The metadata, where it has poses."""
    path = photos.first_file(folder, NAMES)
    return path if path and rgbd.holds(path, b'"poses"') else None


def read(folder: Path, path: Path) -> Scene:
    """Read the frames, by number."""
    data = untrusted.read_json(path)
    untrusted.refuse_near_misses(data, _KNOWN, str(path))
    place = next((folder / name for name in _PLACES if photos.list_photos(folder / name)), None)
    if place is None:
        raise InputError(f"{folder} has no photos in {', '.join(_PLACES)}")
    numbered = rgbd.by_number(place)
    poses = data.get("poses")
    if not isinstance(poses, list) or len(poses) != len(numbered):
        raise InputError(f"{path} has {len(poses) if isinstance(poses, list) else 'no'} poses and {place} has "
                         f"{len(numbered)} photos, expected as many")
    frames = [_frame(folder, data, k, photo, f"{path}, frame {k}") for k, photo in enumerate(numbered)]
    return rgbd.scene_of(folder, frames, rgbd.Depth(1.0, "metres, as the format says"), f"{path} (Record3D)")


def _frame(folder: Path, data: dict[str, Any], k: int, photo: Path, where: str) -> rgbd.Frame:
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
        return rgbd.Frame(photo, pose, K, depth)
    size = untrusted.size(data.get("dw", 192), data.get("dh", 256), f"{where}: depth")[::-1]
    return rgbd.Frame(photo, pose, K, Packed(packed, size, "<f4"),
                      Packed(sure, size, "u1") if sure.is_file() else None)
