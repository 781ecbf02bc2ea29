"""A photo with its camera, and a scene: what every reader returns and every stage takes."""

import pickle
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image

from pagas_cl.errors import InputError, check_kind, kind_of
from pagas_cl.scene import images
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.depth.source import DepthSource
from pagas_cl.scene.images import Loads, image_size, photo_to
from pagas_cl.scene.lens import ThroughLens
from pagas_cl.scene.names import check_names, place_of
from pagas_cl.system.files import digest_array, digest_file, digest_of, translated


def file_behind(source: Any) -> Path | None:
    """The file of a photo, mask or depth map that is one, or is read through a lens or out of an archive; else None."""
    if isinstance(source, ThroughLens):
        return source.path
    return source if isinstance(source, Path) else None


def source_digest(source: Any) -> str:
    """Hash of what a photo or a mask is read from: its content, and what is done to it; "" where there is none."""
    if source is None or hasattr(source, "digest"):
        return getattr(source, "digest", "")
    if isinstance(source, np.ndarray):
        return digest_array(source)
    if isinstance(source, Path):
        return digest_file(source)
    return digest_file(source.path) + digest_of([pickle.dumps(source, protocol=4)])    # a lens, and a path


@dataclass(frozen=True, eq=False)
class View:
    """One photo and its camera, which is of the photo's size.

    `image`: (H, W, 3) uint8 RGB (floating point from 0 to 1 is rounded to 8 bit); `mask`: (H, W), true = keep. Each may
    be a Pillow image, or a path or an object with `load()`, read each time it is needed. Messages and files call the
    view `name`; where that is empty, by the camera's name, or "unnamed".
    """

    camera: Camera
    image: np.ndarray | str | Path | Loads = field(repr=False)
    mask: np.ndarray | str | Path | Loads | None = field(default=None, repr=False)
    name: str = ""

    def __post_init__(self) -> None:
        check_kind(f"view {self.name!r}: camera", self.camera, (Camera,), "pagas_cl.Camera")
        object.__setattr__(self, "name", str(self.name or self.camera.name or "unnamed"))
        if self.image is None:
            raise InputError(f"view {self.name!r} has no image")
        object.__setattr__(self, "image", self._source(self.image, "image"))
        if self.mask is not None:
            object.__setattr__(self, "mask", self._source(self.mask, "mask"))

    def _source(self, value: Any, what: str) -> np.ndarray | Path | Loads:
        """An image or a mask as it is kept: pixels checked, those in a file or behind `load()` where they are."""
        if isinstance(value, (str, Path)):
            return Path(value).absolute()       # workers of a cluster may be at work in other folders
        if images.is_loaded_later(value):
            return value
        if isinstance(value, Image.Image):
            who = f"{what} of view {self.name!r}"
            with translated(f"{who} cannot be decoded (", "); is its file complete, and the image still open?"):
                value = images.pixels_of(value, "RGB" if what == "image" else "L", who)
        return self._converted(value, what)

    @property
    def stem(self) -> str:
        """The name without folders and suffix: what depth maps and pictures of this view are called."""
        return Path(self.name).stem

    def load_image(self) -> npt.NDArray[np.uint8]:
        """The photo, uint8 of shape (H, W, 3)."""
        return self._loaded(self.image, "image", images.read_photo)

    def load_small(self, sizes: Sequence[tuple[int, int]]) -> list[npt.NDArray[np.uint8]]:
        """The photo at other sizes, (width, height), the largest first: uint8 (height, width, 3) each."""
        if isinstance(self.image, Path):
            self._check_size(image_size(self.image), "image")
            return images.read_small(self.image, sizes)
        photo = self.load_image()
        return [photo_to(photo, *size) for size in sizes]

    def load_mask(self) -> npt.NDArray[np.bool_] | None:
        """The mask, bool of shape (H, W), true = keep; None where there is none."""
        return None if self.mask is None else self._loaded(self.mask, "mask", images.read_mask)

    def check_files(self, whole: bool = False) -> None:
        """InputError where a file is missing, unreadable or of another size, by its header, or, `whole`, cut off."""
        for what, source in (("image", self.image), ("mask", self.mask)):
            path = file_behind(source)
            if path is not None:
                self._check_size(image_size(path), what, source.lens.size if isinstance(source, ThroughLens) else ())
                if whole:
                    images.check_whole(path)

    def _loaded(self, source: np.ndarray | str | Path | Loads, what: str,
                read: Callable[[str | Path], np.ndarray]) -> np.ndarray:
        if isinstance(source, np.ndarray):
            return source
        return self._converted(read(source) if isinstance(source, (str, Path)) else source.load(), what)

    def _converted(self, values: Any, what: str) -> np.ndarray:
        pixels = (images.as_photo if what == "image" else images.as_mask)(values, f"{what} of view {self.name!r}")
        self._check_size(pixels.shape[1::-1], what)
        return pixels

    def _check_size(self, size: Sequence[int], what: str, taken: Sequence[int] = ()) -> None:
        """`taken`: size of a photo that is resampled when it is loaded."""
        wanted = taken or (self.camera.width, self.camera.height)
        if tuple(size) == tuple(wanted):
            return
        if what == "mask":
            remedy = "a mask has its photo's size"
        elif same_shape(size, wanted):
            remedy = (f"resize the photo, or the camera (of a COLMAP model: --photos, with the folder of these "
                      "photos; in files: width, height, fx, fy, cx, cy, all times "
                      f"{size[0] / wanted[0]:.4g}; in Python: camera.resized({size[0]}, {size[1]}))")
        else:
            remedy = ("the shapes differ, so it belongs to another photo or was cropped or turned (an EXIF orientation "
                      "is not applied: save the photo with its pixels turned, or calibrate on those stored)")
        path = file_behind(self.mask if what == "mask" else None)
        who = f"mask {str(path)!r} of view" if path is not None else what
        raise InputError(f"{who} {self.name!r} is {size[0]} x {size[1]}, its camera says {wanted[0]} x {wanted[1]}: "
                         f"{remedy}")


def same_shape(one: Sequence[int], other: Sequence[int]) -> bool:
    """Whether two sizes, (width, height), are of one shape, rounded to whole pixels."""
    return abs(one[0] * other[1] / (one[1] * other[0]) - 1) <= 0.5 / min(*one, *other)


@dataclass(frozen=True, eq=False)
class SmallPhoto:
    """Stands for the photo of `view`, or its mask, at another `size`, (width, height)."""

    view: View
    size: tuple[int, int]
    mask: bool = False

    def load(self) -> np.ndarray:
        """uint8 (height, width, 3); of a mask bool (height, width), true where more than half of a pixel is kept."""
        if self.mask:
            return photo_to(np.asarray(self.view.load_mask(), np.float32), *self.size) > 0.5
        return self.view.load_small([self.size])[0]

    @property
    def digest(self) -> str:
        """Hash of what `load` gives, by photo or mask and the size."""
        source = self.view.mask if self.mask else self.view.image
        return digest_of([source_digest(source).encode(), repr(tuple(self.size)).encode()])


def smaller(view: View, scale: float) -> View:
    """The view at `scale` of its size, at least a pixel."""
    camera = view.camera.scaled(scale)
    return View(camera, SmallPhoto(view, camera.size),
                None if view.mask is None else SmallPhoto(view, camera.size, mask=True), view.name)


@dataclass(frozen=True, eq=False)
class Scene:
    """Views, and the folder or file that they were read from, with its format.

    `depths`: where the format has depth maps, one a view (None where a view has none), each with load() and digest;
    `depth_unit`: how their unit is known, in words; `mesh`: the one that the format names, in the cameras' world.
    """

    views: list[View]
    source: str = ""
    depths: Sequence[DepthSource | None] | None = field(default=None, repr=False)
    depth_unit: str = ""
    mesh: Path | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "views", checked_views("views", self.views))
        check_names([view.name for view in self.views], self.source or "scene")

    @property
    def cameras(self) -> list[Camera]:
        """Of `views`, in their order."""
        return [view.camera for view in self.views]

    @property
    def images(self) -> list[Any]:
        """Of `views`, in their order: what refine_mesh takes besides `cameras`, paths where they are files."""
        return [view.image for view in self.views]

    @property
    def masks(self) -> list[Any]:
        """Of `views`, in their order, None where a view has none: what refine_mesh takes as `masks`."""
        return [view.mask for view in self.views]

    @property
    def files(self) -> list[Path]:
        """The files of photos, masks and depth maps."""
        sources = [source for view in self.views for source in (view.image, view.mask)]
        sources += [depth.file for depth in self.depths or () if depth is not None]
        return [path for source in sources if (path := file_behind(source)) is not None]

    def index(self, name: str) -> int:
        """Place of the view called `name` (whole name, file name or stem)."""
        return place_of(name, [view.name for view in self.views], self.source or "the scene")


_VIEWS = "a list of pagas_cl.View, such as read_scene(folder).views"


def listed(name: str, given: Any, expected: str, kind: type = object, each: str = "") -> list[Any]:
    """The list that a caller gave as the argument `name`; InputError where it is none, or one is not of the `kind`."""
    if isinstance(given, (str, bytes, Mapping, Scene, set, frozenset)) or not isinstance(given, Iterable):
        raise InputError(f"{name} is {kind_of(given)}, expected {expected}")
    found = list(given)
    for k, item in enumerate(found):
        check_kind(f"{name}[{k}]", item, (kind,), each or expected)
    return found


def checked_views(name: str, views: Sequence[View]) -> list[View]:
    """The views that a caller gave as the argument `name`; InputError where they are none."""
    return listed(name, views, _VIEWS, View)


def check_apart(target: View, contexts: Sequence[View], held_out: Sequence[View]) -> None:
    """InputError where one photo is in two of these."""
    for one, view, other, more in (("target", target, "contexts", contexts), ("target", target, "held_out", held_out),
                                   *(("one of contexts", view, "held_out", held_out) for view in contexts)):
        if any(view.image is each.image or file_behind(view.image) == file_behind(each.image) is not None
               for each in more):
            raise InputError(f"the photo of view {view.name!r} is given as {one} and as one of {other}, expected it in "
                             "one place: it agrees with itself, whatever the depth")


def joined(views: Sequence[View], results: Sequence[Any]) -> list[tuple[int, Any]]:
    """(place in `views`, result) for each result that is of one of the views, in the order of the results.

    By the view's `name`; where several views have it, by the `camera`. InputError where that leaves a choice.
    """
    called: dict[str, list[int]] = {}
    for place, view in enumerate(views):
        called.setdefault(view.name, []).append(place)
    found: dict[int, Any] = {}
    for result in results:
        places = called.get(result.name, [])
        if len(places) > 1:
            places = ([p for p in places if views[p].camera is result.camera]
                      or [p for p in places if _same(views[p].camera, result.camera)])
        if len(places) > 1:
            raise InputError(f"{len(places)} views are called {result.name!r} and have the same camera, expected a "
                             "name for each, by which its result is found")
        if places and found.setdefault(places[0], result) is not result:
            raise InputError(f"there are two results of view {result.name!r}, expected one")
    return list(found.items())


def _same(one: Camera, other: Camera) -> bool:
    """Whether two cameras are the same in all their numbers."""
    return ((one.width, one.height) == (other.width, other.height) and np.array_equal(one.K, other.K)
            and np.array_equal(one.world_to_camera, other.world_to_camera))
