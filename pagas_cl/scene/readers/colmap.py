"""COLMAP: `images/` and a model in `sparse/0` or `sparse`, binary or text.

Convention: world-to-camera, OpenCV axes, pixel centres at +0.5. PINHOLE and SIMPLE_PINHOLE are used as they are;
photos of other models are undistorted as they are loaded, by pycolmap's lens models. Exports of networks whose cameras
belong to small copies of the photos (MapAnything) are read with `photos=`, the folder of the originals.

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

from pagas_cl.errors import InputError, log, need, short
from pagas_cl.scene import untrusted
from pagas_cl.scene.camera import intrinsics
from pagas_cl.scene.depth.placement import find_placement
from pagas_cl.scene.images import image_size
from pagas_cl.scene.lens import Lens, ThroughLens
from pagas_cl.scene.readers.photos import find_mask, list_photos
from pagas_cl.scene.view import Scene, View
from pagas_cl.system.files import is_file, translated

_SMALL = 0.25      # of the photo's size: no principal point of a photo itself is nearer to the corner
_PLACES = ("sparse/0", "sparse", "colmap/sparse/0", ".")
EXPECTED = f"COLMAP model: looked for cameras and images (.bin or .txt) in {', '.join(_PLACES[:2])}"
# COLMAP's numbers of camera models -> name, number of parameters
MODELS = {0: ("SIMPLE_PINHOLE", 3), 1: ("PINHOLE", 4), 2: ("SIMPLE_RADIAL", 4), 3: ("RADIAL", 5), 4: ("OPENCV", 8),
          5: ("OPENCV_FISHEYE", 8), 6: ("FULL_OPENCV", 12), 7: ("FOV", 5), 8: ("SIMPLE_RADIAL_FISHEYE", 4),
          9: ("RADIAL_FISHEYE", 5), 10: ("THIN_PRISM_FISHEYE", 12), 11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
          12: ("SIMPLE_DIVISION", 4), 13: ("DIVISION", 5), 14: ("SIMPLE_FISHEYE", 3), 15: ("FISHEYE", 4),
          16: ("EUCM", 6), 17: ("EQUIRECTANGULAR", 2)}
_PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE")
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
    camera: int
    world_to_camera: np.ndarray = field(repr=False)


def detect(folder: Path) -> Path | None:
    """The first of the usual places that holds a COLMAP model, or None."""
    return next((folder / place for place in _PLACES for suffix in (".bin", ".txt")
                 if all((folder / place / (part + suffix)).is_file() for part in ("cameras", "images"))), None)


def read(folder: Path, place: Path, *, outside: bool = False, photos: str | Path | None = None) -> Scene:
    """Read the scene; every registered image becomes a view, in the order of their names.

    `photos`: folder of original photos of the same names (or stems), to which the cameras are scaled, crop and padding
    undone: images/ then holds the smaller ones that the cameras belong to.

    InputError for a model that cannot be read, no registered image, photos that are missing or of another size.
    """
    model = _read_model(place)
    _warn_of_other_models(place)
    views = _views_of(model, folder, outside)
    if photos is not None:
        views = _with_originals(views, Path(photos))
    return Scene(views, f"COLMAP model {str(place)!r}")


def _warn_of_other_models(place: Path) -> None:
    """COLMAP writes what it could not join as models of their own: sparse/0, sparse/1, ..."""
    if place.name == "0":
        others = sorted(path.name for path in place.parent.iterdir()
                        if path != place and any(is_file(path / f"images{end}") for end in (".bin", ".txt")))
        if others:
            log.warning("%s is read; %s next to it are other models, of photos that this one may lack", place,
                        ", ".join(others[:5]))


def _views_of(model: list[tuple[ModelImage, ModelCamera]], folder: Path, outside: bool) -> list[View]:
    """Views of the model's images; headers of all photos are checked against their cameras."""
    what, photos = f"the COLMAP model of {str(folder)!r}", folder / "images"
    if not model:
        raise InputError(f"{what} has no registered image")
    paths = {image.name: untrusted.inside(photos, image.name, f"image name in {what}", outside=outside)
             for image, _ in model}
    _check_photos(paths, photos)
    _refuse_small_cameras([camera for _, camera in model], what)
    lenses = dict[int, Lens]()
    views = [_view(image, camera, paths[image.name], folder, lenses) for image, camera in model]
    for view in views:
        view.check_files()
    return views


def _view(image: ModelImage, camera: ModelCamera, path: Path, folder: Path, lenses: dict[int, Lens]) -> View:
    mask = find_mask(folder, path, ("masks",), image.name)
    if camera.model in _PINHOLES:
        pinhole = untrusted.pinhole(camera.K, image.world_to_camera, camera.width, camera.height, image.name)
        return View(pinhole, path, mask, image.name)
    if camera.number not in lenses:
        lens = lenses[camera.number] = Lens.from_colmap(camera.to_pycolmap(), image.name)
        log.info("camera %d is %s: its photos are undistorted to a pinhole of %d x %d pixels, as colmap "
                 "image_undistorter does; depth maps have that size", camera.number, lens.model, *lens.pinhole[:2])
    lens = lenses[camera.number]
    return View(lens.camera(image.world_to_camera, image.name), ThroughLens(path, lens),
                None if mask is None else ThroughLens(mask, lens, "mask"), image.name)


def _check_photos(paths: dict[str, Path], photos: Path) -> None:
    missing = [name for name, path in paths.items() if not is_file(path)]
    if missing and not photos.is_dir():
        raise InputError(f"the folder {str(photos)!r} does not exist; the photos of the COLMAP model must be there")
    if missing:
        more = f" and {len(missing) - 3} more" if len(missing) > 3 else ""
        raise InputError(f"{len(missing)} of {len(paths)} photos of the COLMAP model are missing in {str(photos)!r}: "
                         f"{', '.join(map(short, missing[:3]))}{more}; copy them there, or remove them from the model")


def _refuse_small_cameras(cameras: list[ModelCamera], what: str) -> None:
    """Cameras with the photos' sizes and a network's intrinsics: what Depth Anything 3 writes with a ...crop method."""
    if any(camera.model not in _PINHOLES for camera in cameras):
        return
    across, down = np.transpose([camera.K[:2, 2] / (camera.width, camera.height) for camera in cameras])
    if max(across.max(), down.max()) < _SMALL and np.abs(across / np.maximum(down, 1e-9) - 1).max() < 0.25:
        raise InputError(f"all {len(cameras)} cameras of {what} have their principal point at {across.mean():.2f}, "
                         f"{down.mean():.2f} of the photo's size, not near its middle: the intrinsics belong to "
                         "smaller images (Depth Anything 3 with a ...crop method does not scale them back); export "
                         "with a ...resize method")


def _with_originals(views: list[View], folder: Path) -> list[View]:
    """The views with their photos out of `folder`, by name or stem, and cameras to match.

    How each photo became the small one (stretched, padded, cropped) is found by comparing them. InputError where a
    photo is missing, shows something else, or a view has a mask, which belongs to the small photo.
    """
    if not folder.is_dir():
        raise InputError(f"photos: {folder} is no folder")
    found = list_photos(folder)
    called = {path.stem: path for path in found} | {path.name: path for path in found}
    result, kinds = [], set()
    for view in views:
        photo = called.get(Path(view.name).name) or called.get(view.stem)
        if photo is None:
            raise InputError(f"photos: {folder} holds no photo called {Path(view.name).name}, of the {len(views)} that "
                             "the cameras belong to")
        if view.mask is not None:
            raise InputError(f"view {view.name!r} has a mask of its small photo; put masks next to the originals, or "
                             "leave them out")
        placement = find_placement(photo, (view.camera.width, view.camera.height), view.load_image(), f"photo {photo}")
        kinds.add(placement.kind)
        result.append(View(placement.photo_camera(view.camera, *image_size(photo)), photo, None, view.name))
    old, new = views[0].camera, result[0].camera
    log.info("cameras belong to photos of %d x %d (%s); they are scaled to those in %s, %d x %d", old.width, old.height,
             " and ".join(sorted(kinds)), folder, new.width, new.height)
    return result


def _read_model(place: Path) -> list[tuple[ModelImage, ModelCamera]]:
    """The images of the model in `place`, by name, each with its camera; binary where cameras.bin and images.bin are
    there, else text."""
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
    for row in _rows(data.decode("utf-8").splitlines(), -1, 4, path, "number, model, width, height and parameters"):
        where = f"{path}: camera {short(row[0])}"
        number, width, height = untrusted.floats([row[0], *row[2:4]], where)
        cameras.append(_camera(untrusted.whole(float(number), 0, 2**32 - 1, where), row[1], width, height,
                               untrusted.floats(row[4:], where), where))
    return cameras


def _images_txt(data: bytes, path: Path) -> list[ModelImage]:
    images, lines = [], iter(data.decode("utf-8").splitlines())
    for row in _rows(lines, 9, 10, path, "number, quaternion, translation, camera, name"):
        where = f"{path}: image {short(row[0])}"
        numbers = untrusted.floats(row[:9], where)
        camera = untrusted.whole(float(numbers[8]), 0, 2**32 - 1, f"{where}: camera")
        images.append(_image(numbers[1:8], camera, row[9], where))
        points = next(lines, "").split()  # a second line holds its points, and may be empty
        if len(points) % 3 or points and not untrusted.is_number(points[-1]):
            raise InputError(f"{where}: the line after it holds no points (3 numbers each): is a line missing?")
    return images
