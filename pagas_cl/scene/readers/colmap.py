"""COLMAP: `images/` and a model in `sparse/0` or `sparse`, binary or text.

Convention: world-to-camera, OpenCV axes, pixel centres at +0.5. PINHOLE and SIMPLE_PINHOLE are used as they are;
photos of other models are undistorted as they are loaded, by pycolmap's lens models. Exports of networks whose cameras
belong to small copies of the photos (MapAnything) are read with `photos=`, the folder of the originals; so are models
whose photos are not in images/, or are there at another size.
"""

from os.path import isfile
from pathlib import Path
from unicodedata import normalize

import numpy as np

from pagas_cl.errors import InputError, log, short
from pagas_cl.scene import untrusted
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.depth.placement import find_placement
from pagas_cl.scene.images import image_size
from pagas_cl.scene.lens import Lens, ThroughLens
from pagas_cl.scene.names import file_key
from pagas_cl.scene.readers.colmap_model import PINHOLES, ModelCamera, ModelImage, read_model
from pagas_cl.scene.readers.photos import find_mask, list_photos
from pagas_cl.scene.untrusted import IMAGE_SUFFIXES
from pagas_cl.scene.view import Scene, View, same_shape

_SMALL = 0.25      # of the photo's size: no principal point of a photo itself is nearer to the corner
_PLACES = ("sparse/0", "sparse", "colmap/sparse/0", ".")
EXPECTED = f"COLMAP model: looked for cameras and images (.bin or .txt) in {', '.join(_PLACES[:2])}"


def detect(folder: Path) -> Path | None:
    return next((folder / place for place in _PLACES for suffix in (".bin", ".txt")
                 if all(isfile(folder / place / (part + suffix)) for part in ("cameras", "images"))), None)


def read(folder: Path, place: Path, *, outside: bool = False, photos: str | Path | None = None) -> Scene:
    """Read the scene; every registered image becomes a view, in the order of their names.

    `photos`: folder of original photos of the same names (or stems), to which the cameras are scaled, crop and padding
    undone: images/ then holds the smaller ones that the cameras belong to. Where that is images/ itself, there is no
    images/, or the model has distorted cameras: the folder of the model's photos, at the cameras' size or another one.

    InputError for a model that cannot be read, no registered image, photos that are missing or of another size.
    """
    model = read_model(place)
    _warn_of_other_models(place)
    images, named = folder / "images", None if photos is None else Path(photos).absolute()
    if named is None:
        views = _views_of(model, folder, images, outside)
    elif (images.is_dir() and named.resolve() != images.resolve()
          and all(camera.model in PINHOLES for _, camera in model)):
        views = _with_originals(_views_of(model, folder, images, outside), named)
    else:
        views = _views_of(model, folder, named, outside, resized=True)
    return Scene(views, f"COLMAP model {str(place)!r}")


def _warn_of_other_models(place: Path) -> None:
    """COLMAP writes what it could not join as models of their own: sparse/0, sparse/1, ..."""
    if place.name == "0":
        others = sorted(path.name for path in place.parent.iterdir()
                        if path != place and any(isfile(path / f"images{end}") for end in (".bin", ".txt")))
        if others:
            log.warning("%s is read; %s next to it are other models, of photos that this one may lack: to read one, "
                        "give %s, say, as SCENE, and the folder of the photos as --photos", place,
                        ", ".join(f"{place.parent.name}/{name}" for name in others[:5]), place.parent / others[0])


def _views_of(model: list[tuple[ModelImage, ModelCamera]], folder: Path, photos: Path, outside: bool,
              resized: bool = False) -> list[View]:
    """Views of the model's images, whose files are in `photos`; headers of all are checked against their cameras, which
    become of the photos' size where these have their shape and may be `resized`."""
    what = f"the COLMAP model of {str(folder)!r}"
    if not model:
        raise InputError(f"{what} has no registered image")
    paths = {image.name: untrusted.inside(photos, image.name, f"image name in {what}", outside=outside)
             for image, _ in model}
    _check_photos(paths, photos)
    _refuse_small_cameras([camera for _, camera in model], what)
    if resized:
        old, sizes = model[0][1], [image_size(paths[image.name]) for image, _ in model]
        model = [(image, camera.resized(*size) if same_shape(size, (camera.width, camera.height)) else camera)
                 for (image, camera), size in zip(model, sizes)]
        if model[0][1] is not old:
            _log_scaled(old, model[0][1], photos)
    lenses = dict[ModelCamera, Lens]()
    views = [_view(image, camera, paths[image.name], folder, lenses) for image, camera in model]
    for view in views:
        view.check_files()
    return views


def _view(image: ModelImage, camera: ModelCamera, path: Path, folder: Path, lenses: dict[ModelCamera, Lens]) -> View:
    mask = find_mask(folder, path, ("masks",), image.name)
    if camera.model in PINHOLES:
        pinhole = untrusted.pinhole(camera.K, image.world_to_camera, camera.width, camera.height, image.name)
        return View(pinhole, path, mask, image.name)
    if camera not in lenses:
        lens = lenses[camera] = Lens.from_colmap(camera.to_pycolmap(), image.name)
        log.info("camera %d is %s: its photos are undistorted to a pinhole of %d x %d pixels, as colmap "
                 "image_undistorter does; depth maps have that size", camera.number, lens.model, *lens.pinhole[:2])
    lens = lenses[camera]
    return View(Camera(*lens.pinhole, image.world_to_camera, image.name), ThroughLens(path, lens),
                None if mask is None else ThroughLens(mask, lens, "mask"), image.name)


def _check_photos(paths: dict[str, Path], photos: Path) -> None:
    missing = [name for name, path in paths.items() if not isfile(path)]
    if missing and not photos.is_dir():
        raise InputError(f"the folder {str(photos)!r} does not exist; the photos of the COLMAP model must be there, or "
                         "in the folder of --photos (photos=), where a command has that")
    if missing:
        more = f" and {len(missing) - 3} more" if len(missing) > 3 else ""
        wanted = file_key(Path(missing[0]).with_suffix("").as_posix())
        alike = [path for path in (path.relative_to(photos) for path in sorted(photos.rglob("*")))
                 if path.suffix.lower() in IMAGE_SUFFIXES and file_key(path.with_suffix("").as_posix()) == wanted]
        hint = f" (there is {short(alike[0].as_posix())}, which needs the model's name" if alike else ""
        if alike and normalize("NFC", alike[0].as_posix()) == normalize("NFC", missing[0]):
            hint += ": its accents are encoded otherwise"       # as macOS has them; both look the same
        hint += ")" if hint else ""
        raise InputError(f"{len(missing)} of {len(paths)} photos of the COLMAP model are missing in {str(photos)!r}: "
                         f"{', '.join(map(short, missing[:3]))}{more}{hint}; copy them there, or remove them from "
                         "the model")


def _refuse_small_cameras(cameras: list[ModelCamera], what: str) -> None:
    """Cameras with the photos' sizes and a network's intrinsics: what Depth Anything 3 writes with a ...crop method."""
    if any(camera.model not in PINHOLES for camera in cameras):
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
    _log_scaled(views[0].camera, result[0].camera, folder, f" ({' and '.join(sorted(kinds))})")
    return result


def _log_scaled(old: ModelCamera | Camera, new: ModelCamera | Camera, photos: Path, how: str = "") -> None:
    log.info("cameras belong to photos of %d x %d%s; they are scaled to those in %s, %d x %d", old.width, old.height,
             how, photos, new.width, new.height)
