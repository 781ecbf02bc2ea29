"""A photo with its camera, and a scene: what every reader returns and every stage takes."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pagas_cl.errors import InputError
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.depth_source import DepthSource
from pagas_cl.scene.images import (
    Loads,
    as_mask,
    as_photo,
    image_size,
    photo_to,
    read_mask,
    read_photo,
    read_small,
)
from pagas_cl.scene.names import place_of


@dataclass(frozen=True, eq=False)
class View:
    """One photo and its camera, which is of the photo's size.

    `image`: (H, W, 3) uint8 RGB (floating point from 0 to 1 is rounded to 8 bit); `mask`: (H, W), true = keep. Each may
    be a path or an object with `load()`, read each time it is asked for. Messages and files call the view `name`; where
    that is empty, by the camera's name, or "unnamed".
    """

    camera: Camera
    image: np.ndarray | str | Path | Loads = field(repr=False)
    mask: np.ndarray | str | Path | Loads | None = field(default=None, repr=False)
    name: str = ""

    def __post_init__(self) -> None:
        if not isinstance(self.camera, Camera):
            raise InputError(f"view {self.name!r}: camera is a {type(self.camera).__name__}, expected pagas_cl.Camera")
        object.__setattr__(self, "name", str(self.name or self.camera.name or "unnamed"))
        for what, convert in (("image", as_photo), ("mask", as_mask)):
            value = getattr(self, what)
            if isinstance(value, str):
                object.__setattr__(self, what, Path(value))
            elif value is not None and not isinstance(value, Path) and not hasattr(value, "load"):
                object.__setattr__(self, what, self._fitting(convert(value, f"{what} {self.name!r}"), what))
        if self.image is None:
            raise InputError(f"view {self.name!r} has no image")

    @property
    def stem(self) -> str:
        """The name without folders and suffix: what depth maps and pictures of this view are called."""
        return Path(self.name).stem

    def load_image(self) -> npt.NDArray[np.uint8]:
        """The photo, uint8 of shape (H, W, 3)."""
        return self._loaded(self.image, "image", read_photo)

    def load_small(self, sizes: Sequence[tuple[int, int]]) -> list[npt.NDArray[np.uint8]]:
        """The photo at other sizes, (width, height), the largest first: uint8 (height, width, 3) each."""
        if isinstance(self.image, Path):
            self._check_size(image_size(self.image), (self.camera.width, self.camera.height), "image")
            return read_small(self.image, sizes)
        photo = self.load_image()
        return [photo_to(photo, *size) for size in sizes]

    def load_mask(self) -> npt.NDArray[np.bool_] | None:
        """The mask, bool of shape (H, W), true = keep; None where there is none."""
        return None if self.mask is None else self._loaded(self.mask, "mask", read_mask)

    def check_files(self) -> None:
        """Raise InputError where a file is missing, unreadable or of another size; reads headers only."""
        for what in ("image", "mask"):
            source = getattr(self, what)
            path = getattr(source, "path", source)
            if isinstance(path, Path):
                size = image_size(path)
                self._check_size(size, getattr(source, "size", (self.camera.width, self.camera.height)), what)

    def _loaded(self, source: np.ndarray | str | Path | Loads, what: str,
                read: Callable[[str | Path], np.ndarray]) -> np.ndarray:
        if isinstance(source, np.ndarray):
            return source
        return self._fitting(read(source) if isinstance(source, (str, Path)) else source.load(), what)

    def _fitting(self, pixels: np.ndarray, what: str) -> np.ndarray:
        self._check_size(pixels.shape[1::-1], (self.camera.width, self.camera.height), what)
        return pixels

    def _check_size(self, size: Sequence[int], wanted: Sequence[int], what: str) -> None:
        if tuple(size) == tuple(wanted):
            return
        ratio = (size[0] / wanted[0], size[1] / wanted[1])
        rows = 0.5 / min(*size, *wanted)
        if what == "mask":
            remedy = "a mask has its photo's size"
        elif abs(ratio[0] / ratio[1] - 1) <= rows:
            remedy = f"resize the photo, or use camera.resized({size[0]}, {size[1]})"
        else:
            remedy = "the shapes differ, so it belongs to another photo or was cropped or turned"
        source = getattr(self, what)
        path = getattr(source, "path", source)
        named = f"{str(path)!r} of view {self.name!r}" if what == "mask" and isinstance(path, Path) else repr(self.name)
        raise InputError(f"{what} {named} is {size[0]} x {size[1]}, its camera says {wanted[0]} x {wanted[1]}: "
                         f"{remedy}")


@dataclass(frozen=True, eq=False)
class Scene:
    """Views, and the folder or file that they were read from, with its format.

    `points`: sparse points (N, 3) float64 where the format has them; nothing needs them. `depths`: where the format has
    depth maps, one a view (None where a view has none), each with load() and digest; `depth_unit`: how their unit is
    known, in words.
    """

    views: list[View]
    source: str = ""
    points: npt.NDArray[np.float64] | None = field(default=None, repr=False)
    depths: Sequence[DepthSource | None] | None = field(default=None, repr=False)
    depth_unit: str = ""

    def __post_init__(self) -> None:
        twice = [name for name, count in Counter(view.name for view in self.views).items() if count > 1]
        if twice:
            raise InputError(f"{self.source or 'scene'}: view {min(twice)!r} is there twice, expected one name a view")

    @property
    def cameras(self) -> list[Camera]:
        """Of `views`, in their order."""
        return [view.camera for view in self.views]

    @property
    def images(self) -> list[Any]:
        """Of `views`, in their order: what refine_mesh takes beside `cameras`, paths where they are files."""
        return [view.image for view in self.views]

    def index(self, name: str) -> int:
        """Place of the view called `name` (whole name, file name or stem)."""
        return place_of(name, [view.name for view in self.views], self.source or "the scene")
