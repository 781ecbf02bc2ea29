"""COLMAP's files themselves (cameras, images, points3D; .bin or .txt), read with every count and number checked.

pycolmap reads them too, but trusts them: a damaged count makes it read for hours or ask for all memory, an unknown
camera model ends the process. It is left what only it can do, the lens models (scene.lens).
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from pagas_cl.errors import InputError, need
from pagas_cl.scene.readers import untrusted

# COLMAP's numbers of camera models -> name, number of parameters
MODELS = {0: ("SIMPLE_PINHOLE", 3), 1: ("PINHOLE", 4), 2: ("SIMPLE_RADIAL", 4), 3: ("RADIAL", 5), 4: ("OPENCV", 8),
          5: ("OPENCV_FISHEYE", 8), 6: ("FULL_OPENCV", 12), 7: ("FOV", 5), 8: ("SIMPLE_RADIAL_FISHEYE", 4),
          9: ("RADIAL_FISHEYE", 5), 10: ("THIN_PRISM_FISHEYE", 12), 11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
          12: ("SIMPLE_DIVISION", 4), 13: ("DIVISION", 5), 14: ("SIMPLE_FISHEYE", 3), 15: ("FISHEYE", 4),
          16: ("EUCM", 6), 17: ("EQUIRECTANGULAR", 2)}
_COUNTS = dict(MODELS.values())
_Part = TypeVar("_Part")     # of a model: what one of its files holds
_BYTES = 16 << 30
_NAME = 4096
_UNIT = 1e-2  # COLMAP writes unit quaternions; one further off is damage


@dataclass(frozen=True)
class ModelCamera:
    """A camera as COLMAP has it: `params` in the model's order."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    @property
    def K(self) -> np.ndarray:
        """Intrinsics (3, 3) of PINHOLE and SIMPLE_PINHOLE, pixel centres at +0.5."""
        fx, fy, cx, cy = self.params if self.model == "PINHOLE" else (self.params[0], *self.params)
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])

    def to_pycolmap(self) -> Any:
        """The same as a pycolmap.Camera."""
        pycolmap = need("pycolmap", "colmap", "undistorting photos")
        if self.model not in pycolmap.CameraModelId.__members__:
            raise InputError(f"camera model {self.model} is unknown to this pycolmap ({pycolmap.__version__}); "
                             "undistort first: colmap image_undistorter")
        return pycolmap.Camera(model=self.model, width=self.width, height=self.height, params=list(self.params))


@dataclass(frozen=True, eq=False)
class ModelImage:
    """A registered image: its name, its camera's number, and world-to-camera (4, 4)."""

    name: str
    camera_id: int
    world_to_camera: np.ndarray = field(repr=False)


@dataclass(frozen=True, eq=False)
class Model:
    """A COLMAP model; images in the order of the file."""

    cameras: dict[int, ModelCamera]
    images: list[ModelImage]
    points: np.ndarray = field(repr=False)


def read_model(place: Path) -> Model:
    """The model in `place`, binary where cameras.bin and images.bin are there, else text."""
    place = Path(place)
    binary = all((place / f"{part}.bin").is_file() for part in ("cameras", "images"))
    suffix = ".bin" if binary else ".txt"
    cameras = _guarded(place / f"cameras{suffix}", _cameras_bin if binary else _cameras_txt)
    images = _guarded(place / f"images{suffix}", _images_bin if binary else _images_txt)
    names = [image.name for image in images]
    for image in images:
        if image.camera_id not in cameras:
            raise InputError(f"{place}: image {untrusted.short(image.name)} has camera {image.camera_id}, which is not "
                             f"in cameras{suffix}")
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(f"{place}: image {untrusted.short(twice)} is there twice")
    points = place / f"points3D{suffix}"
    found = _guarded(points, _points_bin if binary else _points_txt) if points.is_file() else np.zeros((0, 3))
    return Model(cameras, images, found)


def _guarded(path: Path, read: Callable[[bytes, Path], _Part]) -> _Part:
    data = untrusted.read_bytes(path, _BYTES)
    try:
        return read(data, path)
    except InputError:
        raise
    except (struct.error, ValueError, IndexError, OverflowError) as error:
        raise InputError(f"the COLMAP model cannot be read: {path}: {str(error)[:120]}; is it cut off or "
                         "damaged?") from error


def _camera(model: str, width: float, height: float, params: Sequence[float] | np.ndarray,
            where: str) -> ModelCamera:
    if len(params) != _COUNTS[model]:
        raise InputError(f"{where}: {model} has {len(params)} parameters, expected {_COUNTS[model]}")
    for side, value in (("width", width), ("height", height)):
        untrusted.whole(value, 1, untrusted.MAX_SIDE, f"{where}: {side}")
    if not np.isfinite(params).all() or np.abs(params).max(initial=0) > 1e9:
        raise InputError(f"{where}: the parameters are {untrusted.short(list(params))}, expected finite numbers of "
                         "pixels")
    return ModelCamera(model, int(width), int(height), tuple(float(p) for p in params))


def _image(numbers: npt.ArrayLike, camera: int, name: str, where: str) -> ModelImage:
    """`numbers`: quaternion w x y z and translation."""
    numbers = np.asarray(numbers, np.float64)
    sane = np.isfinite(numbers).all() and np.abs(numbers[:4]).max() < 2
    length = float(np.linalg.norm(numbers[:4])) if sane else np.nan
    if not abs(length - 1) < _UNIT:
        raise InputError(f"{where}: the quaternion {untrusted.short(numbers[:4].tolist())} has length {length:g}, "
                         "expected 1")
    w, x, y, z = numbers[:4] / length
    pose = np.eye(4)
    pose[:3, :3] = [[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]]
    pose[:3, 3] = numbers[4:]
    return ModelImage(name, camera, pose)


def _records(data: bytes, least: int) -> int:
    """The count at the start of a binary file, refused where not even the smallest records would fit."""
    count: int = struct.unpack_from("<Q", data, 0)[0]
    if count * least > len(data) - 8:
        raise ValueError(f"it says {count} records and has {len(data)} bytes")
    return count


def _ended(place: int, data: bytes) -> None:
    if place != len(data):
        raise ValueError(f"{len(data) - place} bytes follow the last record")


def _cameras_bin(data: bytes, path: Path) -> dict[int, ModelCamera]:
    cameras, place = {}, 8
    for _ in range(_records(data, 24)):
        number, model, width, height = struct.unpack_from("<IiQQ", data, place)
        if model not in MODELS:
            raise InputError(f"{path}: camera {number} has model number {model}, which is unknown; undistort first: "
                             "colmap image_undistorter")
        if number in cameras:
            raise InputError(f"{path}: camera {number} is there twice")
        name, count = MODELS[model]
        params = struct.unpack_from(f"<{count}d", data, place + 24)
        cameras[number] = _camera(name, width, height, params, f"{path}: camera {number}")
        place += 24 + 8 * count
    _ended(place, data)
    return cameras


def _images_bin(data: bytes, path: Path) -> list[ModelImage]:
    images, place = [], 8
    for _ in range(_records(data, 73)):
        number, *pose = struct.unpack_from("<I7d", data, place)
        (camera,) = struct.unpack_from("<I", data, place + 60)
        end = data.index(b"\0", place + 64, place + 64 + _NAME)
        name = data[place + 64:end].decode("utf-8")
        (points,) = struct.unpack_from("<Q", data, end + 1)
        place = end + 9 + 24 * points
        if place > len(data):
            raise ValueError(f"image {number} says that it has {points} points")
        images.append(_image(pose, camera, name, f"{path}: image {number}"))
    _ended(place, data)
    return images


def _points_bin(data: bytes, path: Path) -> np.ndarray:
    count, place = _records(data, 51), 8
    points, track = np.empty((count, 3)), struct.Struct("<8x3d11xQ")
    for row in range(count):
        *points[row], length = track.unpack_from(data, place)
        place += 51 + 8 * length  # number, position, colour, error, length of the track; then the track
        if place > len(data):
            raise ValueError(f"point {row} says that {length} images see it")
    _ended(place, data)
    return points


def _lines(data: bytes) -> list[str]:
    return [line.strip() for line in data.decode("utf-8").splitlines()]


def _cameras_txt(data: bytes, path: Path) -> dict[int, ModelCamera]:
    cameras = {}
    for line in _lines(data):
        if not line or line.startswith("#"):
            continue
        tokens = line.split()
        where = f"{path}: camera {untrusted.short(tokens[0])}"
        if len(tokens) < 4:
            raise InputError(f"{where}: {len(tokens)} words, expected number, model, width, height and parameters")
        if tokens[1] not in _COUNTS:
            raise InputError(f"{where} has model {untrusted.short(tokens[1])}, which is unknown; undistort first: "
                             "colmap image_undistorter")
        number, width, height = (untrusted.word(tokens[k], where) for k in (0, 2, 3))
        if number in cameras:
            raise InputError(f"{where} is there twice")
        cameras[int(untrusted.whole(number, 0, 2**32 - 1, where))] = _camera(
            tokens[1], width, height, untrusted.words(tokens[4:], where), where)
    return cameras


def _images_txt(data: bytes, path: Path) -> list[ModelImage]:
    images, lines = [], iter(_lines(data))
    for line in lines:
        if not line or line.startswith("#"):
            continue
        tokens = line.split(maxsplit=9)
        where = f"{path}: image {untrusted.short(tokens[0])}"
        if len(tokens) < 10:
            raise InputError(f"{where}: {len(tokens)} words, expected number, quaternion, translation, camera, name")
        numbers = untrusted.words(tokens[:9], where)
        camera = untrusted.whole(float(numbers[8]), 0, 2**32 - 1, f"{where}: camera")
        images.append(_image(numbers[1:8], camera, tokens[9], where))
        points = next(lines, "").split()  # a second line holds its points, and may be empty
        if len(points) % 3 or points and not untrusted.is_number(points[-1]):
            raise InputError(f"{where}: the line after it holds no points (3 numbers each): is a line missing?")
    return images


def _points_txt(data: bytes, path: Path) -> np.ndarray:
    rows = [line.split(maxsplit=4)[1:4] for line in _lines(data) if line and not line.startswith("#")]
    if any(len(row) != 3 for row in rows):
        raise InputError(f"{path}: a line has fewer than 4 words: is the file damaged?")
    return untrusted.words([token for row in rows for token in row], str(path)).reshape(-1, 3)
