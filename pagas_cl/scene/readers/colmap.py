"""COLMAP: `images/` and a model in `sparse/0` or `sparse`, binary or text.

Convention: world-to-camera, OpenCV axes, pixel centres at +0.5. PINHOLE and SIMPLE_PINHOLE are used as they are;
photos of other models are undistorted as they are loaded, by pycolmap's lens models. Exports of networks whose cameras
belong to small copies of the photos (MapAnything) are read with `photos=`, the folder of the originals.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from pagas_cl.errors import InputError, log, short
from pagas_cl.scene import untrusted
from pagas_cl.scene.depth.placement import find_placement
from pagas_cl.scene.images import image_size
from pagas_cl.scene.lens import Lens, ThroughLens
from pagas_cl.scene.readers.colmap_model import ModelCamera, ModelImage, read_model
from pagas_cl.scene.readers.photos import find_mask, list_photos
from pagas_cl.scene.view import Scene, View
from pagas_cl.system.files import is_file

_SMALL = 0.25      # of the photo's size: no principal point of a photo itself is nearer to the corner
_PLACES = ("sparse/0", "sparse", "colmap/sparse/0", ".")
EXPECTED = f"COLMAP model: looked for cameras and images (.bin or .txt) in {', '.join(_PLACES[:2])}"


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
    model = read_model(place)
    _warn_of_other_models(place)
    views = _views_of(model, folder / "images", folder, outside)
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


def _views_of(model: list[tuple[ModelImage, ModelCamera]], photos: Path, folder: Path, outside: bool) -> list[View]:
    """Views of the model's images; headers of all photos are checked against their cameras."""
    if not model:
        raise InputError(f"the COLMAP model of {str(photos.parent)!r} has no registered image")
    what = f"image name in the COLMAP model of {str(photos.parent)!r}"
    paths = {image.name: untrusted.inside(photos, image.name, what, outside=outside) for image, _ in model}
    _check_photos(paths, photos)
    _refuse_small_cameras([camera for _, camera in model], photos)
    lenses = dict[int, Lens]()
    views = [_view(image, camera, paths[image.name], folder, lenses) for image, camera in model]
    for view in views:
        view.check_files()
    return views


def _view(image: ModelImage, camera: ModelCamera, path: Path, folder: Path, lenses: dict[int, Lens]) -> View:
    mask = find_mask(folder, path, ("masks",), image.name)
    if camera.model in ("PINHOLE", "SIMPLE_PINHOLE"):
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


def _refuse_small_cameras(cameras: list[ModelCamera], photos: Path) -> None:
    """Cameras with the photos' sizes and a network's intrinsics: what Depth Anything 3 writes with a ...crop method."""
    if any(camera.model not in ("PINHOLE", "SIMPLE_PINHOLE") for camera in cameras):
        return
    across, down = np.transpose([camera.K[:2, 2] / (camera.width, camera.height) for camera in cameras])
    if max(across.max(), down.max()) < _SMALL and np.abs(across / np.maximum(down, 1e-9) - 1).max() < 0.25:
        raise InputError(f"all {len(cameras)} cameras of the COLMAP model of {str(photos.parent)!r} have their "
                         f"principal point at {across.mean():.2f}, {down.mean():.2f} of the photo's size, not near "
                         "its middle: the intrinsics belong to smaller images (Depth Anything 3 with a ...crop method "
                         "does not scale them back); export with a ...resize method")


def _with_originals(views: list[View], folder: Path) -> list[View]:
    """The views with their photos out of `folder`, by name or stem, and cameras to match.

    How each photo became the small one (stretched, padded, cropped) is found by comparing them. InputError where a
    photo is missing, shows something else, or a view has a mask, which belongs to the small photo.
    """
    if not folder.is_dir():
        raise InputError(f"photos: {folder} is no folder")
    found = list_photos(folder)
    names = {path.name: path for path in found}
    stems = {path.stem: path for path in found}
    result, kinds = [], set()
    for view in views:
        photo = names.get(Path(view.name).name) or stems.get(view.stem)
        if photo is None:
            raise InputError(f"photos: {folder} holds no photo called {Path(view.name).name}, of the {len(views)} that "
                             "the cameras belong to")
        if view.mask is not None:
            raise InputError(f"view {view.name!r} has a mask of its small photo; put masks next to the originals, or "
                             "leave them out")
        small = view.camera.width, view.camera.height
        placement = find_placement(photo, small, view.load_image(), f"photo {photo}")
        kinds.add(placement.kind)
        camera = placement.photo_camera(view.camera, *image_size(photo))
        result.append(View(replace(camera, name=view.name), photo, None, view.name))
    log.info("cameras belong to photos of %d x %d (%s); they are scaled to those in %s, %d x %d", views[0].camera.width,
             views[0].camera.height, " and ".join(sorted(kinds)), folder, result[0].camera.width,
             result[0].camera.height)
    return result
