"""A depth map that a scene's format names: where it is, its unit, what of it is left out, how it lies in the photo."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np
import numpy.typing as npt
from PIL import Image

from pagas_cl.errors import InputError, log
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.depth.formats import check_aspect, check_pixels, plane_of, read_values, stored_shape
from pagas_cl.scene.depth.placement import Placement
from pagas_cl.scene.depthmap import clean_depth, nearest, resize_depth
from pagas_cl.scene.images import Loads
from pagas_cl.scene.lens import Lens, ThroughLens
from pagas_cl.scene.sampling import evenly
from pagas_cl.system.files import digest_file, digest_of, translated

LEFT_OUT = 0.25       # depths of less than this share of the median confidence are left out
_SAMPLED = 8            # maps of confidence that the median is taken of


class Stored(Loads, Protocol):
    """An array in some file, such as scene.npy_files.ArrayRef."""

    @property
    def digest(self) -> str:
        """Hash of what `load` gives."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Of what `load` gives, by the file's header."""


@dataclass(frozen=True)
class DepthSource:
    """Loads as float32 (H, W) of the view's `size` (width, height), z-depth in scene units, 0 = no surface. Far more
    pixels than the view's, or another shape where no `placement` says how it lies there, are refused.

    `scale`: the file's number for one scene unit; `placement`: how the photo lies in the map (stretched over it where
    None); `confidence` below `least` and depths equal to `invalid` are left out. `lens`: of a photo that is undistorted
    when it is loaded; its map is, too, but for one of the size of the undistorted photo.
    """

    file: Path | Stored
    size: tuple[int, int]
    scale: float = 1.0
    placement: Placement | None = None
    confidence: Path | Stored | None = None
    least: float = 0.0
    invalid: float | None = None
    lens: Lens | None = None

    def __post_init__(self) -> None:
        if not (np.isfinite(self.scale) and self.scale > 0):
            raise InputError(f"depth scale is {self.scale}, expected a number above 0")

    @property
    def digest(self) -> str:
        names = [digest_file(file) if isinstance(file, Path) else file.digest
                 for file in (self.file, self.confidence) if file is not None]
        numbers = (self.size, self.scale, self.placement, self.least, self.invalid, *([self.lens] if self.lens else ()))
        return digest_of([f"{names} {numbers}".encode()])

    @property
    def through(self) -> Lens | None:
        """The lens that the map shows the scene through; None for one of the undistorted photo's size."""
        undistorted = self.lens is None or plane_of(shape_of(self.file), str(self.file)) == self.size[::-1]
        return None if undistorted else self.lens

    def check(self) -> None:
        """InputError where the headers say that depth or confidence cannot be of the view; nothing is decoded."""
        through = self.through
        photo = through.size if through else self.size
        for file in (self.file, self.confidence):
            if file is not None:
                shape, who = shape_of(file), f"{'depth map' if file is self.file else 'confidence'} {file}"
                check_pixels(shape, photo, who)
                plane = plane_of(shape, who)
                if self.placement is None:
                    check_aspect(*plane, photo, who)

    def load(self) -> npt.NDArray[np.float32]:
        """The depth map; InputError where the file is damaged, or as `check`."""
        self.check()
        values = flat(self.file)
        if self.invalid is not None:
            values = np.where(values == self.invalid, 0, values)
        if self.confidence is not None and self.least > 0:
            sure = flat(self.confidence, grey=True)
            values = np.where(nearest(sure, values.shape[1], values.shape[0]) >= self.least, values, 0)
        depth = clean_depth(values if self.scale == 1 else values / self.scale, str(self.file))
        through = self.through
        if through is not None:
            return through.undistorted_depth(resize_depth(depth, *through.size))
        if self.placement is None:
            return resize_depth(depth, *self.size)
        return self.placement.photo_depth(depth, *self.size)

    def low(self) -> float:
        """Share of the map, where the photo lies in it, that is left out for its confidence."""
        sure = np.zeros((0, 0)) if self.confidence is None else flat(self.confidence, grey=True)
        if self.placement is not None:
            sides = zip(self.placement.offset, self.placement.scale, self.size)
            across, down = (slice(max(0, round(start)), max(0, round(start + scale * n))) for start, scale, n in sides)
            sure = sure[down, across]
        return float(np.mean(~(sure >= self.least))) if sure.size else 0.0


def of_photo(file: Path, photo: Any, camera: Camera, scale: float = 1.0) -> DepthSource:
    """A depth map of the `photo` of a view with this camera, in a file."""
    return DepthSource(file, (camera.width, camera.height), scale,
                       lens=photo.lens if isinstance(photo, ThroughLens) else None)


@dataclass(frozen=True)
class Adjusted:
    """Another depth map times `factor` plus `shift` (scene units) where it has a surface; 0 where that is below 0."""

    source: Any         # has load(), and digest where a run keeps what it finishes
    factor: float
    shift: float

    @property
    def digest(self) -> str:
        return digest_of([f"{self.source.digest} {self.factor.hex()} {self.shift.hex()}".encode()])

    def load(self) -> npt.NDArray[np.float32]:
        return adjusted(self.source.load(), self.factor, self.shift)


def rescaled(depth: Any, factor: float, shift: float) -> Any:
    """A depth map, or what loads one, adjusted so; the same object where nothing changes."""
    if depth is None or (factor == 1 and shift == 0):
        return depth
    return Adjusted(depth, factor, shift) if isinstance(depth, Loads) else adjusted(np.asarray(depth), factor, shift)


def adjusted(depth: np.ndarray, factor: float, shift: float) -> npt.NDArray[np.float32]:
    """`factor` depth + `shift` where there is a surface and that is above 0, else 0."""
    moved = np.where(depth > 0, np.maximum(factor * depth.astype(np.float64) + shift, 0), 0)
    return moved.astype(np.float32)


def shape_of(file: Path | Stored) -> tuple[int, ...]:
    """The shape of what a file, or what stands for it, holds, by the file's header."""
    return stored_shape(file) if isinstance(file, Path) else file.shape


def flat(file: Path | Stored, grey: bool = False) -> np.ndarray:
    """A map (H, W) out of a file, without axes of length 1; `grey`: an image of 8 bit will do."""
    if not isinstance(file, Path):
        values = file.load()
    elif grey and file.suffix.lower() == ".png":
        with translated(f"{file} cannot be read: "), Image.open(file) as image:
            values = np.asarray(image if image.mode.startswith("I") else image.convert("L"))
    else:
        values = read_values(file)
    return values.reshape(plane_of(values.shape, str(file)))


_Depth = TypeVar("_Depth", DepthSource, DepthSource | None)


def with_least_confidence(depths: Sequence[_Depth], where: str, least: float | None = None) -> list[_Depth]:
    """The depth maps without what is of a confidence below `least`, measured where it is None; the share is logged."""
    sure = [depth for depth in depths if depth is not None and depth.confidence is not None]
    if not sure:
        return list(depths)
    found = _least_confidence(sure, where) if least is None else least
    log.info("%s: depths that it marks as uncertain (confidence below %.3g) are left out, %.0f %%", where, found,
             100 * np.mean([replace(depth, least=found).low() for depth in sure[:_SAMPLED]]))
    return [depth and replace(depth, least=found) for depth in depths]


def _least_confidence(depths: Sequence[DepthSource], where: str) -> float:
    """A quarter of the median, counted from 1 where all are 1 or more (networks write 1 + exp)."""
    parts = []
    for k in evenly(len(depths), _SAMPLED):
        depth = depths[k]
        depth.check()
        parts.append(flat(depth.confidence, grey=True)[::4, ::4].ravel())
    values = np.concatenate(parts)
    if values.dtype.kind in "iub":       # levels, 0 = low
        return float(values[values > 0].min(initial=values.max()))
    values = values[np.isfinite(values)]
    if not len(values):
        raise InputError(f"{where}: no confidence is a finite number; export without it")
    low = 1.0 if values.min() >= 1 else 0.0
    return float(low + LEFT_OUT * (np.median(values) - low))
