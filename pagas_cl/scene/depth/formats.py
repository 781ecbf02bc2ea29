"""The formats of depth maps on disk: what a file's header says of its size, and the numbers in it as they are."""

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from pagas_cl.errors import InputError, need, short
from pagas_cl.scene.images import image_size, open_image
from pagas_cl.scene.npy_files import first_shape, npy_shape, read_first, read_npy
from pagas_cl.system.files import opened, translated

MOST_TIMES = 100          # as many pixels as its photo a depth map may have: sides ten times as long
PATCH = 14                # networks of the family that gives depth see sides that are multiples of it
_EXR_CHANNELS = ("R", "Y", "Z", "V", "G", "B")       # the first that is there holds the depth; Z, next to colours
_BACKGROUND = np.float32(1e10)        # Blender's depth where there is nothing
_MOST_CHANNELS = 16


@dataclass(frozen=True)
class Format:
    """`shape` reads the header alone; `values` all of the file, and raises one of system.files.DAMAGE."""

    shape: Callable[[Path], tuple[int, ...]]
    values: Callable[[Path], np.ndarray]


def stored_shape(path: Path) -> tuple[int, ...]:
    """The shape that a depth map's header says; nothing is decoded."""
    with translated(f"depth map {short(str(path))} cannot be read: "):
        return _format_of(path).shape(path)


def read_values(path: Path) -> np.ndarray:
    """The numbers of a depth map's file as they are."""
    with translated(f"depth map {str(path)!r} cannot be read: "):
        return _format_of(path).values(path)


def plane_of(shape: Sequence[int], who: str) -> tuple[int, int]:
    """(height, width) of an array of this shape, which may have axes of length 1 before and behind; else InputError."""
    left = tuple(shape)
    while len(left) > 2 and 1 in (left[0], left[-1]):
        left = left[1:] if left[0] == 1 else left[:-1]
    if len(left) != 2 or 0 in left:
        raise InputError(f"{who} has shape {tuple(shape)}, expected (height, width)")
    return left[0], left[1]


def check_pixels(shape: Sequence[int], photo: tuple[int, int], who: str) -> None:
    """InputError where a map has far more pixels than its photo of size (width, height): it may unpack to gigabytes."""
    if math.prod(shape) > MOST_TIMES * photo[0] * photo[1]:
        raise InputError(f"{who} has shape {tuple(shape)}, more than {MOST_TIMES} times the pixels of its photo, which "
                         f"is {photo[0]} x {photo[1]}: is it of this photo? Make it smaller, or the photo larger")


def check_aspect(height: int, width: int, photo: tuple[int, int], who: str) -> None:
    """InputError where a map that shows all of a photo of size (width, height) has another shape than networks make."""
    tolerance = 1 + most_bent(width, height)

    def fits(width: int, height: int) -> bool:
        return 1 / tolerance <= width * photo[1] / (height * photo[0]) <= tolerance

    if fits(width, height):
        return
    reason = ("it is transposed: save it as (height, width)" if fits(height, width) else
              "it was cropped or belongs to another photo: give one that shows what the photo shows")
    raise InputError(f"{who} is {width} x {height} (width x height) and its photo is {photo[0]} x {photo[1]}, of "
                     f"another shape: {reason}")


def most_bent(width: int, height: int) -> float:
    """By how much an image of this size may have another aspect than the photo that it shows all of: a network rounds
    its sides to whole patches (3 % at the 500 pixels that are usual)."""
    return 0.5 * PATCH / min(width, height) + 0.005


def _format_of(path: Path) -> Format:
    if not path.is_file():
        raise InputError(f"depth map {short(str(path))} does not exist")
    found = FORMATS.get(path.suffix.lower())
    if found is None:
        raise InputError(f"depth map {str(path)!r}: unknown kind, expected one of {', '.join(SUFFIXES)}")
    return found


def _raw(header: Callable[[BinaryIO], tuple[int, int, str]], rows: int = 1) -> Format:
    """A header, which says height, width and dtype, and 4 bytes a pixel; `rows` is -1 where the bottom comes first."""
    def shape(path: Path) -> tuple[int, ...]:
        with opened(path) as file:
            return header(file)[:2]

    def values(path: Path) -> np.ndarray:
        with opened(path) as file:
            height, width, dtype = header(file)
            want, got = 4 * width * height, path.stat().st_size - file.seek(0, os.SEEK_CUR)
            if want != got or want <= 0:      # before it is read
                raise ValueError(f"its header says {width} x {height}, {want} bytes, and {got} follow")
            return np.frombuffer(file.read(want), dtype).reshape(height, width)[::rows]

    return Format(shape, values)


def _pfm_header(file: BinaryIO) -> tuple[int, int, str]:
    """Of a portable float map of one channel: byte order by the sign of the scale."""
    head = [file.readline(64).split() for _ in range(3)]
    try:
        kind, (width, height), order = head[0][0], (int(n) for n in head[1]), float(head[2][0])
    except (IndexError, ValueError) as error:
        raise ValueError("its header is no PFM header") from error
    if kind != b"Pf":
        raise ValueError(f"it starts with {kind[:8]!r}, expected b'Pf' (one channel)")
    return height, width, "<f4" if order < 0 else ">f4"


def _colmap_header(file: BinaryIO) -> tuple[int, int, str]:
    """Of COLMAP's dense map: "width&height&channels&", then x fastest."""
    numbers = file.read(64).split(b"&", 3)
    if len(numbers) != 4 or not all(n.isdigit() for n in numbers[:3]):
        raise ValueError("its header is not 'width&height&channels&'")
    width, height, channels = (int(n) for n in numbers[:3])
    file.seek(sum(len(n) + 1 for n in numbers[:3]))
    if channels != 1:
        raise ValueError(f"it has {channels} channels, expected 1 (a depth map, not a normal map)")
    return height, width, "<f4"


def _read_png(path: Path) -> np.ndarray:
    with open_image(path) as image:
        if not image.mode.startswith("I"):
            raise ValueError(f"it is {image.mode}, expected a 16-bit grey PNG")
        return np.asarray(image).astype(np.float64)


def _exr_header(path: Path) -> tuple[Any, tuple[int, int], str]:
    """The library, (height, width), and the name of the channel that holds the depth."""
    library = need("OpenEXR", "exr", f"reading {short(str(path))}")
    with library.File(str(path), header_only=True) as file:
        if len(file.parts) != 1 or file.header()["type"] not in (library.scanlineimage, library.tiledimage):
            raise ValueError("it has several parts or deep pixels, expected one image")
        low, high = ([int(n) for n in corner] for corner in file.header()["dataWindow"])
        channels = [channel.name for channel in file.header()["channels"]]
    width, height = high[0] - low[0] + 1, high[1] - low[1] + 1
    name = next((name for name in ("Z", *_EXR_CHANNELS) if name in channels), None)
    if name is None or len(channels) > _MOST_CHANNELS or width < 1 or height < 1:
        raise ValueError(f"it is {width} x {height} with the channels {short(', '.join(channels))}, expected one of "
                         f"{', '.join(_EXR_CHANNELS)} among at most {_MOST_CHANNELS}")
    return library, (height, width), name


def _read_exr(path: Path) -> np.ndarray:
    library, shape, name = _exr_header(path)
    with library.File(str(path), separate_channels=True) as file:
        values = np.asarray(file.channels()[name].pixels)
    if values.shape != shape:
        raise ValueError(f"channel {name} has shape {values.shape}, expected {shape}")
    return np.where(values >= _BACKGROUND, 0, values)


FORMATS = {".npz": Format(first_shape, read_first), ".npy": Format(npy_shape, read_npy),
           ".pfm": _raw(_pfm_header, -1), ".exr": Format(lambda path: _exr_header(path)[1], _read_exr),
           ".png": Format(lambda path: image_size(path)[::-1], _read_png), ".bin": _raw(_colmap_header)}
SUFFIXES = (".npz", ".npy", ".pfm", ".exr", ".png", ".geometric.bin", ".photometric.bin")
