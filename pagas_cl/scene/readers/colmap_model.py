"""The files of a COLMAP model: cameras and images, binary or text, as COLMAP has them.

pycolmap reads models too, but trusts them: a damaged count makes it read for hours or ask for all memory, an unknown
camera model ends the process. It is left what only it can do, the lens models (scene.lens).
"""

import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from pagas_cl.errors import InputError, need, short
from pagas_cl.scene import untrusted
from pagas_cl.scene.camera import intrinsics
from pagas_cl.system.files import translated

# COLMAP's numbers of camera models -> name, number of parameters
MODELS = {0: ("SIMPLE_PINHOLE", 3), 1: ("PINHOLE", 4), 2: ("SIMPLE_RADIAL", 4), 3: ("RADIAL", 5), 4: ("OPENCV", 8),
          5: ("OPENCV_FISHEYE", 8), 6: ("FULL_OPENCV", 12), 7: ("FOV", 5), 8: ("SIMPLE_RADIAL_FISHEYE", 4),
          9: ("RADIAL_FISHEYE", 5), 10: ("THIN_PRISM_FISHEYE", 12), 11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
          12: ("SIMPLE_DIVISION", 4), 13: ("DIVISION", 5), 14: ("SIMPLE_FISHEYE", 3), 15: ("FISHEYE", 4),
          16: ("EUCM", 6), 17: ("EQUIRECTANGULAR", 2)}
PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE")
_COUNTS = dict(MODELS.values())
_Part = TypeVar("_Part")     # of a model: what one of its files holds
_BYTES = 16 << 30
_NAME = 4096


@dataclass(frozen=True)
class ModelCamera:
    """A camera as COLMAP has it: its number, and `params` in the model's order."""

    number: int
    model: str
    width: int
    height: int
    params: tuple[float, ...]

    @property
    def K(self) -> np.ndarray:
        """Intrinsics (3, 3) of PINHOLE and SIMPLE_PINHOLE, pixel centres at +0.5."""
        return intrinsics(*(self.params if self.model == "PINHOLE" else (self.params[0], *self.params)))

    def resized(self, width: int, height: int) -> "ModelCamera":
        """The same camera for photos of its shape and another size, pixels; itself where that is its own."""
        if (width, height) == (self.width, self.height):
            return self
        if self.model in PINHOLES:
            sx, sy, K = width / self.width, height / self.height, self.K
            return ModelCamera(self.number, "PINHOLE", width, height,
                               (sx * K[0, 0], sy * K[1, 1], sx * K[0, 2], sy * K[1, 2]))
        camera = self.to_pycolmap()
        camera.rescale(width, height)
        return ModelCamera(self.number, self.model, width, height, tuple(float(p) for p in camera.params))

    def to_pycolmap(self) -> Any:
        pycolmap = need("pycolmap", "colmap", "undistorting photos")
        if self.model not in pycolmap.CameraModelId.__members__:
            raise InputError(f"camera model {self.model} is unknown to this pycolmap ({pycolmap.__version__}); "
                             "undistort first: colmap image_undistorter")
        return pycolmap.Camera(model=self.model, width=self.width, height=self.height, params=list(self.params))


@dataclass(frozen=True, eq=False)
class ModelImage:
    """A registered image: its name, its camera's number, and world-to-camera (4, 4)."""

    name: str
    camera: int
    world_to_camera: np.ndarray = field(repr=False)


def read_model(place: Path) -> list[tuple[ModelImage, ModelCamera]]:
    """The images of the model in `place`, by name, each with its camera; binary where that is there, else text."""
    binary = all((place / f"{part}.bin").is_file() for part in ("cameras", "images"))
    suffix = ".bin" if binary else ".txt"
    cameras = _read_part(place / f"cameras{suffix}", _cameras_bin if binary else _cameras_txt)
    images = _read_part(place / f"images{suffix}", _images_bin if binary else _images_txt)
    for what, parts in (("camera", [camera.number for camera in cameras]), ("image", [image.name for image in images])):
        if untrusted.twice(parts) is not None:
            raise InputError(f"{place}: {what} {short(untrusted.twice(parts))} is there twice")
    known = {camera.number: camera for camera in cameras}
    for image in images:
        if image.camera not in known:
            raise InputError(f"{place}: image {short(image.name)} has camera {image.camera}, which is not in "
                             f"cameras{suffix}")
    return [(image, known[image.camera]) for image in sorted(images, key=lambda image: image.name)]


def _read_part(path: Path, read: Callable[[bytes, Path], _Part]) -> _Part:
    data = untrusted.read_bytes(path, _BYTES)
    with translated(f"the COLMAP model cannot be read: {path}: ", "; is it cut off or damaged?"):
        return read(data, path)


def _camera(number: int, model: str | int, width: float, height: float, params: Sequence[float] | np.ndarray,
            where: str) -> ModelCamera:
    if not isinstance(model, str) or model not in _COUNTS:
        raise InputError(f"{where} has model {short(model)}, which is unknown; undistort first: colmap "
                         "image_undistorter")
    if len(params) != _COUNTS[model]:
        raise InputError(f"{where}: {model} has {len(params)} parameters, expected {_COUNTS[model]}")
    if not np.isfinite(params).all() or np.abs(params).max(initial=0) > 1e9:
        raise InputError(f"{where}: the parameters are {short(list(params))}, expected finite numbers of pixels")
    return ModelCamera(number, model, *untrusted.size(width, height, where), tuple(float(p) for p in params))


def _image(numbers: npt.ArrayLike, camera: int, name: str, where: str) -> ModelImage:
    """`numbers`: quaternion w x y z and translation."""
    w, x, y, z, *shift = np.asarray(numbers, np.float64)
    return ModelImage(name, camera, untrusted.pose((x, y, z, w), shift, where))


def _records(data: bytes, least: int, read: Callable[[int], tuple[_Part, int]]) -> list[_Part]:
    """What `read(place)`, which returns the next one's place too, makes of each record of a binary file."""
    (count,), place, found = struct.unpack_from("<Q", data, 0), 8, []
    if count * least > len(data) - place:
        raise ValueError(f"it says {count} records and has {len(data)} bytes")
    for row in range(count):
        record, place = read(place)
        found.append(record)
        if place > len(data):
            raise ValueError(f"record {row} says that it goes on behind the end of the file")
    if place != len(data):
        raise ValueError(f"{len(data) - place} bytes follow the last record")
    return found


def _cameras_bin(data: bytes, path: Path) -> list[ModelCamera]:
    def read(place: int) -> tuple[ModelCamera, int]:
        number, model, width, height = struct.unpack_from("<IiQQ", data, place)
        name, count = MODELS.get(model, (model, 0))
        params = struct.unpack_from(f"<{count}d", data, place + 24)
        return _camera(number, name, width, height, params, f"{path}: camera {number}"), place + 24 + 8 * count

    return _records(data, 24, read)


def _images_bin(data: bytes, path: Path) -> list[ModelImage]:
    def read(place: int) -> tuple[ModelImage, int]:
        number, *pose, camera = struct.unpack_from("<I7dI", data, place)
        end = data.index(b"\0", place + 64, place + 64 + _NAME)
        name = data[place + 64:end].decode("utf-8")
        (points,) = struct.unpack_from("<Q", data, end + 1)
        return _image(pose, camera, name, f"{path}: image {number}"), end + 9 + 24 * points

    return _records(data, 73, read)


def _rows(lines: Iterable[str], splits: int, least: int, path: Path, columns: str) -> Iterator[list[str]]:
    """The words of each line that is neither empty nor a comment, split at most `splits` times (-1: everywhere)."""
    for line in map(str.strip, lines):
        if line and not line.startswith("#"):
            row = line.split(maxsplit=splits)
            if len(row) < least:
                raise InputError(f"{path}: line {short(line)} has {len(row)} fields, expected {columns}")
            yield row


def _cameras_txt(data: bytes, path: Path) -> list[ModelCamera]:
    cameras = []
    for row in _rows(data.decode("utf-8-sig").splitlines(), -1, 4, path, "number, model, width, height and parameters"):
        where = f"{path}: camera {short(row[0])}"
        number, width, height = untrusted.floats([row[0], *row[2:4]], where)
        cameras.append(_camera(untrusted.whole(float(number), 0, 2**32 - 1, where), row[1], width, height,
                               untrusted.floats(row[4:], where), where))
    return cameras


def _images_txt(data: bytes, path: Path) -> list[ModelImage]:
    images, lines = [], iter(data.decode("utf-8-sig").splitlines())
    for row in _rows(lines, 9, 10, path, "number, quaternion, translation, camera, name"):
        where = f"{path}: image {short(row[0])}"
        numbers = untrusted.floats(row[:9], where)
        camera = untrusted.whole(float(numbers[8]), 0, 2**32 - 1, f"{where}: camera")
        images.append(_image(numbers[1:8], camera, row[9], where))
        points = next(lines, "").split()  # a second line holds its points, and may be empty
        if len(points) % 3 or points and not untrusted.is_number(points[-1]):
            raise InputError(f"{where}: the line after it holds no points (3 numbers each): is a line missing?")
    return images
