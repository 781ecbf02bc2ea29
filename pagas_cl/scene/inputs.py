"""The caller's cameras, photos and masks, as views."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from pagas_cl.errors import InputError
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.images import Loads
from pagas_cl.scene.names import place_of
from pagas_cl.scene.view import View

# A list of Camera, an Open3D PinholeCameraTrajectory or a pycolmap Reconstruction; of the last two, which are optional,
# nothing can be said here.
Cameras: TypeAlias = Sequence[Camera] | Any
# One a camera: arrays (H, W, 3) or paths in the order of the cameras, or by camera name; or the folder that holds them.
Images: TypeAlias = Iterable[np.ndarray | str | Path] | Mapping[str, np.ndarray | str | Path] | str | Path
# A depth map (H, W), z-depth in scene units, or what loads it.
Depth: TypeAlias = np.ndarray | Loads


def as_cameras(cams: Cameras) -> list[Camera]:
    """The list of Camera; of a reconstruction in the order of the image names."""
    if hasattr(cams, "parameters"):
        return [Camera.from_open3d(p, name=f"{k:05d}") for k, p in enumerate(cams.parameters)]
    if hasattr(cams, "images") and hasattr(cams, "cameras"):
        images = sorted(cams.images.values(), key=lambda image: image.name)
        return [Camera.from_colmap(cams.cameras[image.camera_id], image) for image in images]
    cameras = list(cams)
    for k, camera in enumerate(cameras):
        if not isinstance(camera, Camera):
            raise InputError(f"cams[{k}] is a {type(camera).__name__}, expected pagas_cl.Camera (see its from_... "
                             "constructors), or an Open3D PinholeCameraTrajectory or a pycolmap Reconstruction "
                             "instead of the list")
    return cameras


def as_views(cams: Cameras, images: Images, masks: Images | None = None) -> list[View]:
    """One View a camera; a folder of images or masks holds files called as the cameras are."""
    cameras = as_cameras(cams)
    if not cameras:
        raise InputError("no cameras were given, expected at least two")
    photos = _matched(images, cameras, "images")
    keep = [None] * len(cameras) if masks is None else _matched(masks, cameras, "masks")
    return [View(camera, photo, mask, camera.name or f"{k:05d}")
            for k, (camera, photo, mask) in enumerate(zip(cameras, photos, keep))]


def depth_maps(views: Sequence[View], depths: Sequence[Depth | npt.ArrayLike | None]) -> list[Any]:
    """Depth maps as arrays of numbers, one a view; what loads one, or None, as it is."""
    if len(depths) != len(views):
        raise InputError(f"{len(depths)} depth maps were given for {len(views)} views, expected one each "
                         "(None where there is none)")
    return [depth if depth is None or isinstance(depth, Loads) else _numbers(depth, view)
            for view, depth in zip(views, depths)]


def _numbers(depth: npt.ArrayLike, view: View) -> np.ndarray:
    try:
        values = np.asarray(depth)
    except ValueError as error:      # rows of different lengths
        raise InputError(f"depth map of view {view.name!r} is no array ({error}), expected numbers of shape (H, W)"
                         ) from error
    if values.dtype.kind not in "fiu":
        raise InputError(f"depth map of view {view.name!r} has dtype {values.dtype}, expected numbers: z-depth in "
                         "scene units")
    return values


def checked_depth(depth: npt.ArrayLike, view: View) -> np.ndarray:
    """The depth map as an array, of the view's size and with at least one valid pixel."""
    depth = _numbers(depth, view)
    size = view.camera.height, view.camera.width
    if depth.shape != size:
        raise InputError(f"depth map of view {view.name!r} has shape {depth.shape}, its photo {size}; resize it with "
                         "pagas_cl.scene.depthmap.resize_depth")
    if not (_any_surface(depth[::16, ::16]) or _any_surface(depth)):
        raise InputError(f"depth map of view {view.name!r} has no valid pixel (all are zero, negative or not finite); "
                         "expected z-depths in scene units")
    return depth


def depth_array(depth: Depth) -> np.ndarray:
    """The depth map itself, read where an object with load() stands for it."""
    return np.asarray(depth.load() if isinstance(depth, Loads) else depth)


def _any_surface(depth: np.ndarray) -> bool:
    return bool((np.isfinite(depth) & (depth > 0)).any())


def asked_views(views: Sequence[View], depths: Sequence[Depth | None], names: Collection[str] | None) -> list[int]:
    """Places of the views called `names`; of all that have a depth map where names is None."""
    have = [k for k, depth in enumerate(depth_maps(views, depths))
            if depth is not None and (isinstance(depth, Loads) or np.any(depth > 0))]
    if names is None:
        if not have:
            raise InputError("no view has a depth map with a valid pixel: nothing to refine")
        return have
    known = [view.name for view in views]
    return list(dict.fromkeys(place_of(name, known) for name in names))


def _matched(given: Images, cameras: list[Camera], what: str) -> list[Any]:
    if isinstance(given, (str, Path)):
        folder = Path(given)
        if not folder.is_dir():
            raise InputError(f"{what}: {folder} is no folder; give a folder, a list in the order of the cameras, or a "
                             "dict by camera name")
        return [folder / camera.name for camera in cameras]
    if isinstance(given, Mapping):
        missing = [camera.name for camera in cameras if camera.name not in given]
        if missing:
            raise InputError(f"{what}: none for camera {missing[0]!r} ({len(missing)} of {len(cameras)} are missing)")
        return [given[camera.name] for camera in cameras]
    each = list(given)
    if len(each) != len(cameras):
        raise InputError(f"{len(each)} {what} were given for {len(cameras)} cameras, expected one each, "
                         "in the same order")
    return each
