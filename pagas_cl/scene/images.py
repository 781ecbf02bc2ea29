"""Photos and masks: files or arrays in, 8-bit RGB and boolean arrays out."""

import os
import struct
from collections.abc import Sequence
from contextlib import AbstractContextManager
from os.path import isfile
from pathlib import Path
from threading import Lock
from typing import Any, Protocol, TypeGuard, runtime_checkable

import numpy as np
import numpy.typing as npt
from PIL import ExifTags, Image
from PIL.PngImagePlugin import PngInfo

from pagas_cl.errors import InputError, kind_of, log
from pagas_cl.scene.own_files import TEXT_MARK
from pagas_cl.system.files import replaced, translated

MOST_PIXELS = 500_000_000      # of a photo: 1.5 GB as RGB
_DAMAGE = (OSError, SyntaxError, ValueError)
_ENDS = {"JPEG": b"\xff\xd9", "PNG": b"IEND"}      # what stands at the end of a file, and never among its pixels
_one_opens = Lock()


@runtime_checkable
class Loads(Protocol):
    """What stands for an array, of a photo, a mask or a depth map: it is loaded each time it is needed."""

    def load(self) -> np.ndarray:
        """The array."""


def image_size(path: str | Path) -> tuple[int, int]:
    """Width and height of an image file, from its header alone."""
    with open_image(Path(path)) as image:
        return image.size


def check_whole(path: Path) -> None:
    """InputError where a JPEG or PNG file is cut off: what does not end as its format does is decoded, to find out."""
    with open_image(path) as image, _damaged(path), open(path, "rb") as file:
        file.seek(max(0, file.seek(0, os.SEEK_END) - 64))       # some programs put a little behind the end
        if _ENDS.get(image.format or "", b"") not in file.read():
            image.load()


def read_photo(path: str | Path) -> npt.NDArray[np.uint8]:
    """Read a photo as it is stored: uint8 of shape (H, W, 3), RGB.

    An EXIF orientation is not applied, since cameras are calibrated on the stored pixels; transparency is dropped.
    """
    return as_photo(_decoded(Path(path), "RGB"), f"image {str(path)!r}")


def read_small(path: Path, sizes: Sequence[tuple[int, int]]) -> list[npt.NDArray[np.uint8]]:
    """A photo at other sizes, (width, height), largest first; a JPEG is decoded no larger, in a quarter of the time."""
    with open_image(path) as image, _damaged(path):
        drafted = image.draft("RGB", sizes[0]) if image.format == "JPEG" else None
        if drafted is None:
            photo = read_photo(path)
            return [photo_to(photo, *size) for size in sizes]
        small, (_, box) = image.convert("RGB"), drafted         # the box of its pixels that is the photo
        # box filters would move what they average by half a pixel here and there
        return [np.asarray(small.resize(size, Image.Resampling.HAMMING, box)) for size in sizes]


def read_mask(path: str | Path) -> npt.NDArray[np.bool_]:
    """Read a mask: bool of shape (H, W), true (white, or opaque where the image has an alpha channel) = keep."""
    return as_mask(_decoded(Path(path), "L"), f"mask {str(path)!r}")


def is_loaded_later(value: Any) -> TypeGuard[Loads]:
    """Whether `value` stands for an array; images of Pillow and tensors of Open3D have a load() of another meaning."""
    return isinstance(value, Loads) and not (isinstance(value, Image.Image) or _is_tensor(value))


def _is_tensor(value: Any) -> bool:
    """Whether it is a tensor of Open3D, which NumPy takes for objects."""
    return type(value).__module__.startswith("open3d") and type(value).__name__ == "Tensor"


def as_array(values: Any, who: str, expected: str) -> np.ndarray:
    """The numbers or truth values that a caller gave, called `who` in messages, of a shape `expected` in words."""
    if isinstance(values, np.ma.MaskedArray):
        raise InputError(f"{who} is a masked array, expected one without a mask of its own: fill it (filled(0))")
    try:
        found = np.asarray(values.cpu().numpy() if _is_tensor(values) else values)
    except (TypeError, ValueError, RuntimeError) as error:      # rows of different lengths; a tensor on a GPU
        raise InputError(f"{who} is no array ({error}), expected numbers of shape {expected}") from error
    if found.dtype.kind not in "fiub":
        raise InputError(f"{who} is {kind_of(values)}, expected an array of numbers of shape {expected}")
    return found


def as_photo(pixels: npt.ArrayLike, who: str = "image") -> npt.NDArray[np.uint8]:
    """8-bit RGB, uint8 (H, W, 3), C-contiguous, of an array that a message calls `who`.

    `pixels`: (H, W), (H, W, 1), (H, W, 3) or (H, W, 4), uint8, uint16 (0..65535), or floating point from 0 to 1.
    """
    photo = as_array(pixels, who, "(height, width, 3), RGB")
    if photo.ndim == 2:
        photo = photo[..., None]
    if photo.ndim != 3 or photo.shape[2] not in (1, 3, 4) or 0 in photo.shape:
        raise InputError(f"{who} has shape {photo.shape}, expected (height, width, 3), RGB")
    photo = photo[..., :3]
    if photo.dtype.kind == "f":
        if not np.isfinite(photo).all():
            raise InputError(f"{who} holds values that are not finite; photos are numbers from 0 to 1, or 8-bit")
        low, high = float(photo.min()), float(photo.max())
        if low < -1e-3 or high > 1.001:
            raise InputError(f"{who} is floating point and runs from {low:.3g} to {high:.3g}, expected 0 to 1; "
                             "divide by 255, or pass uint8")
        photo = np.rint(np.clip(photo, 0, 1) * 255).astype(np.uint8)
    elif photo.dtype.kind == "u" and photo.dtype.itemsize == 2:
        top = int(photo.max())
        if 1 < top < 256:
            raise InputError(f"{who} is 16-bit and runs to {top}, expected 65535 for white; pass uint8")
        if 1 < top < 4096:
            log.warning("%s has 16 bits and no value above %d of 65535, of which 8 bits keep %d levels: multiply its "
                        "values (by 16 where they are 12-bit)", who, top, round(top / 257) + 1)
        photo = np.rint(photo / 257.0).astype(np.uint8)
    elif photo.dtype != np.uint8:
        raise InputError(f"{who} has dtype {photo.dtype}, expected uint8, uint16 or floating point from 0 to 1")
    if photo.shape[2] == 1:
        photo = np.repeat(photo, 3, axis=2)
    return np.ascontiguousarray(photo)


def as_mask(values: npt.ArrayLike, who: str = "mask") -> npt.NDArray[np.bool_]:
    """A mask as bool (H, W): true = keep.

    Of integers those above half of the dtype's range, or of 255 where nothing exceeds that, are true (above 0 where
    nothing exceeds 1), of floating point numbers those above 0.5: anti-aliased borders are cut in the middle.
    """
    values = as_array(values, who, "(height, width)")
    if values.ndim == 3 and values.shape[2] in (1, 3, 4):
        values = values[..., 0] if values.shape[2] < 4 else values[..., 3]
    if values.ndim != 2 or values.size == 0:
        raise InputError(f"{who} has shape {values.shape}, expected (height, width)")
    if values.dtype.kind == "f":
        return values > 0.5  # NaN is not above anything: dropped
    if values.dtype.kind in "iu":
        top, most = np.iinfo(values.dtype).max, values.max(initial=0)
        return values > (0 if most <= 1 else 127 if top > 2**16 or most < 256 < top else top // 2)
    return values.copy()


def bilinear(pixels: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Values of an image (H, W) or (H, W, C) at positions x, y, pixel centres at +0.5, border repeated.

    A position that is not finite gets some value or other.
    """
    height, width = pixels.shape[:2]
    x = np.fmin(np.fmax(x - 0.5, 0), width - 1)       # NaN: 0
    y = np.fmin(np.fmax(y - 0.5, 0), height - 1)
    left = np.minimum(x.astype(np.intp), max(width - 2, 0))
    top = np.minimum(y.astype(np.intp), max(height - 2, 0))
    fx = (x - left).astype(x.dtype)
    fy = (y - top).astype(y.dtype)
    if pixels.ndim == 3:
        fx, fy = fx[..., None], fy[..., None]
    flat = pixels.reshape(height * width, *pixels.shape[2:])
    right = min(1, width - 1)
    first = top * width + left
    upper = flat.take(first, axis=0) * (1 - fx) + flat.take(first + right, axis=0) * fx
    first += width * min(1, height - 1)
    lower = flat.take(first, axis=0) * (1 - fx) + flat.take(first + right, axis=0) * fx
    return np.asarray(upper * (1 - fy) + lower * fy)


def photo_to(photo: np.ndarray, width: int, height: int) -> np.ndarray:
    """A photo, (H, W, 3) uint8 or (H, W) float32, at another size: area average, or interpolated where a side grows."""
    if photo.shape[:2] == (height, width):
        return photo
    grows = width > photo.shape[1] or height > photo.shape[0]
    kind = Image.Resampling.BILINEAR if grows else Image.Resampling.BOX
    return np.asarray(Image.fromarray(photo).resize((width, height), kind))


def write_image(path: Path, pixels: np.ndarray) -> None:
    """Write uint8 pixels, with the mark of pagas_cl, whole or not at all; the suffix says the kind."""
    mark = PngInfo()
    mark.add_text("Software", TEXT_MARK)
    with replaced(path, path.suffix) as temporary:      # .jpg have a quality and a comment, .png have texts
        Image.fromarray(pixels).save(temporary, quality=92, comment=TEXT_MARK, pnginfo=mark)


def open_image(path: Path) -> Image.Image:
    """An image file, its header read, of at most MOST_PIXELS; no TIFF file that Pillow would turn."""
    if not isfile(path):
        raise InputError(f"image {str(path)!r} is not a file" if os.path.exists(path)
                         else f"image {str(path)!r} does not exist")
    with translated(f"image {str(path)!r} cannot be read (",
                    "); is it a PNG, JPEG or TIFF file of 8 or 16 bits, and complete?", _DAMAGE), _one_opens:
        # Pillow takes photos of more than 179 megapixels, which cameras make, for attacks: its limit, which is the
        # whole process', rests meanwhile
        limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
        try:
            image = Image.open(path)
        finally:
            Image.MAX_IMAGE_PIXELS = limit
    if image.width * image.height > MOST_PIXELS:
        raise InputError(f"image {str(path)!r} has {image.width} x {image.height} pixels, expected at most "
                         f"{MOST_PIXELS / 1e6:.0f} million: make photo and camera smaller (Camera.resized)")
    if image.format == "TIFF" and orientation_of(image) in range(2, 9):      # some cameras write 0: not known
        raise InputError(f"image {str(path)!r} has {orientation_of(image)} in its tag Orientation, expected 1 or none, "
                         "since not all programs turn its pixels by it: save it with pixels as the cameras have them")
    return image


def orientation_of(image: Image.Image) -> Any:
    """How an image file's header says that its pixels are to be turned, by the numbers of EXIF: 1 is not at all."""
    if image.format != "TIFF" and "exif" not in image.info:
        return 1        # else Pillow decodes a PNG file, to look behind its pixels
    try:
        return image.getexif().get(ExifTags.Base.Orientation, 1)
    except (*_DAMAGE, KeyError, TypeError, struct.error):       # all that its reader raises
        return 1


def _decoded(path: Path, mode: str) -> np.ndarray:
    with open_image(path) as image, _damaged(path):
        return pixels_of(image, mode, f"image {str(path)!r}")


def pixels_of(image: Image.Image, mode: str, who: str) -> np.ndarray:
    """Pixels as uint8, uint16 or float32; `mode` "RGB" or "L", which takes a varying alpha channel for the mask."""
    if image.mode.startswith("I") or image.mode == "F":
        values = np.asarray(image)
        if values.dtype.kind == "f":
            return values
        if values.min() < 0 or values.max() > 65535:
            raise InputError(f"{who} holds values from {values.min()} to {values.max()}, expected 8 or 16 bit")
        return values.astype(np.uint16)
    if mode == "L" and "A" in image.getbands():
        alpha = np.asarray(image.getchannel("A"))
        if alpha.min() != alpha.max():
            return alpha
    return np.asarray(image.convert(mode))


def has_alpha(path: Path) -> bool:
    """Whether an image file says that it has an alpha channel, or a transparent colour; reads the header."""
    with open_image(path) as image:
        return image.mode != "LAB" and ("A" in image.getbands() or "transparency" in image.info)


def _damaged(path: Path) -> AbstractContextManager[None]:
    return translated(f"image {str(path)!r} cannot be decoded (", "); the file is damaged or cut off: copy it again",
                      _DAMAGE)
