"""Depth maps on disk: (H, W) float32, z-depth in scene units, 0 = no surface."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import BinaryIO

import numpy as np
import numpy.typing as npt

from pagas_cl.errors import InputError
from pagas_cl.scene.exr import read_exr
from pagas_cl.scene.files import read_first, read_npy, replaced, translated
from pagas_cl.scene.pyramid import depth_down, depth_up

log = logging.getLogger("pagas_cl")

# What became of each pixel's depth; DepthResult.status says what each means.
NO_SURFACE, REFINED, KEPT, REJECTED = range(4)
SUFFIXES = (".npz", ".npy", ".pfm", ".exr", ".png", ".geometric.bin", ".photometric.bin")


def find_depth(folder: str | Path, image_name: str) -> Path | None:
    """The depth map of a photo in `folder`: `<stem>` or the whole `<image name>` (as COLMAP does) plus a suffix."""
    folder = Path(folder)
    names = str(Path(image_name).with_suffix("")), Path(image_name).stem, image_name, Path(image_name).name
    places = (folder / (name + suffix) for suffix in SUFFIXES for name in names)
    return next((path for path in places if path.is_file()), None)


def load_depth(path: str | Path, size: tuple[int, int] | None = None, *,
               scale: float | None = None) -> npt.NDArray[np.float32]:
    """Read a depth map: (H, W) float32, 0 where it is not finite or below 0.

    Parameters
    ----------
    path : path
        .npz (its first array), .npy, .pfm, 16-bit .png, COLMAP's .geometric.bin / .photometric.bin, or .exr.
    size : (width, height), optional
        Size wanted; another size is resampled by `resize_depth`.
    scale : float, optional
        The file's number for one scene unit (1000 for millimetres in a scene of metres); a PNG needs it, else 1.
    """
    path = Path(path)
    if scale is None and path.suffix.lower() == ".png" and path.is_file():
        raise InputError(f"depth map {str(path)!r}: a PNG does not say its unit; give the depth scale (1000 for "
                         "millimetres in a scene of metres)")
    if scale is not None and not (np.isfinite(scale) and scale > 0):
        raise InputError(f"depth scale is {scale}, expected a number above 0")
    values = read_values(path)
    depth = clean_depth(values if scale is None else values / scale, str(path))
    return depth if size is None else resize_depth(depth, *size)


def read_values(path: Path) -> np.ndarray:
    """The numbers of a depth map's file as they are."""
    if not path.is_file():
        raise InputError(f"depth map {str(path)!r} does not exist")
    readers = {".npz": read_first, ".npy": read_npy, ".pfm": _read_pfm, ".png": _read_png, ".bin": _read_colmap,
               ".exr": read_exr}
    read = readers.get(path.suffix.lower())
    if read is None:
        raise InputError(f"depth map {str(path)!r}: unknown kind, expected one of {', '.join(SUFFIXES)}")
    with translated(f"depth map {str(path)!r} cannot be read: "):
        return read(path)


def surface_depth(depth: np.ndarray) -> npt.NDArray[np.float32]:
    """A copy as float32, 0 where there is no surface: 0, negative, not finite, or too large for float32."""
    with np.errstate(over="ignore"):
        depth = depth.astype(np.float32)
    bits = depth.view(np.uint32)
    bits *= (depth > 0) & (depth < np.inf)      # times 0 or 1, on the bits: NaN and infinity end too
    return depth


def clean_depth(values: npt.ArrayLike, who: str = "depth map") -> npt.NDArray[np.float32]:
    """Depth as (H, W) float32 with what is not finite, or below 0, set to 0 (and counted in the log)."""
    values = np.asarray(values)
    if values.ndim == 3 and 1 in (values.shape[0], values.shape[2]):
        values = values[0] if values.shape[0] == 1 else values[..., 0]
    if values.ndim != 2 or values.size == 0:
        raise InputError(f"{who} has shape {values.shape}, expected (height, width)")
    if values.dtype.kind not in "fiu":
        raise InputError(f"{who} has dtype {values.dtype}, expected numbers")
    with np.errstate(over="ignore", invalid="ignore"):
        depth = values.astype(np.float32)
        bad = ~np.isfinite(depth) | (depth < 0)
    count = int(np.count_nonzero(bad))
    if count:
        log.info("%s: %d of %d depths are not finite or below 0, taken as no surface", who, count, depth.size)
        depth[bad] = 0
    return depth


def save_depth(path: str | Path, depth: npt.ArrayLike) -> None:
    """Write an .npz with one array, "depth", float32; beside the final name first, then renamed."""
    with replaced(path) as beside, open(beside, "wb") as file:
        np.savez(file, depth=np.ascontiguousarray(depth, np.float32))


def resize_depth(depth: npt.ArrayLike, width: int, height: int) -> npt.NDArray[np.float32]:
    """Depth map at another size: linear where it grows and the area's mean where it shrinks, over valid depths only.

    A pixel is valid iff the input pixel that its centre lies in is (where it shrinks: iff half of the covered area is).
    """
    depth = np.asarray(depth, np.float32)
    if depth.shape == (height, width):
        return depth
    if width <= depth.shape[1] and height <= depth.shape[0]:
        share = depth_down(np.where(depth > 0, np.float32(2), np.float32(1)), width, height)
        return np.ascontiguousarray(np.where(share >= 1.5, depth_down(depth, width, height), np.float32(0)))
    rows = ((np.arange(height) + 0.5) * depth.shape[0] / height).astype(np.intp)
    columns = ((np.arange(width) + 0.5) * depth.shape[1] / width).astype(np.intp)
    valid = (depth > 0)[rows[:, None], columns[None, :]]
    return np.ascontiguousarray(np.where(valid, depth_up(depth, width, height), np.float32(0)))


def _read_pfm(path: Path) -> np.ndarray:
    """Portable float map, one channel: rows from the bottom, byte order by the sign of the scale."""
    with open(path, "rb") as file:
        head = [file.readline(64).split() for _ in range(3)]
        try:
            kind, (width, height), order = head[0][0], (int(n) for n in head[1]), float(head[2][0])
        except (IndexError, ValueError) as error:
            raise ValueError("its header is no PFM header") from error
        if kind != b"Pf":
            raise ValueError(f"it starts with {kind[:8]!r}, expected b'Pf' (one channel)")
        values = _exactly(file, path, width, height, 1, "<f4" if order < 0 else ">f4")
    return values.reshape(height, width)[::-1]


def _read_colmap(path: Path) -> np.ndarray:
    """COLMAP's dense map: "width&height&channels&", then float32, x fastest."""
    with open(path, "rb") as file:
        head = file.read(64)
        numbers = head.split(b"&", 3)
        if len(numbers) != 4 or not all(n.isdigit() for n in numbers[:3]):
            raise ValueError("its header is not 'width&height&channels&'")
        width, height, channels = (int(n) for n in numbers[:3])
        file.seek(sum(len(n) + 1 for n in numbers[:3]))
        if channels != 1:
            raise ValueError(f"it has {channels} channels, expected 1 (a depth map, not a normal map)")
        return _exactly(file, path, width, height, channels, "<f4").reshape(height, width)


def _exactly(file: BinaryIO, path: Path, width: int, height: int, channels: int, dtype: str) -> np.ndarray:
    """The rest of a file, refused before it is read when its size is not what the header claims."""
    want, got = 4 * width * height * channels, path.stat().st_size - file.tell()
    if want != got or want <= 0:
        raise ValueError(f"its header says {width} x {height}, {want} bytes, and {got} follow")
    return np.frombuffer(file.read(want), dtype)


def _read_png(path: Path) -> np.ndarray:
    from PIL import Image

    with Image.open(path) as image:
        if not image.mode.startswith("I"):
            raise ValueError(f"it is {image.mode}, expected a 16-bit grey PNG")
        return np.asarray(image).astype(np.float64)
