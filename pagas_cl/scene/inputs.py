"""The caller's cameras, photos and masks, as views."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from os.path import isfile
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
from PIL import Image

from pagas_cl.errors import InputError, kind_of, short
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.depth.source import DepthSource
from pagas_cl.scene.images import Loads, as_array, is_loaded_later
from pagas_cl.scene.names import place_of
from pagas_cl.scene.readers.photos import check_masks, find_mask
from pagas_cl.scene.view import Scene, View, checked_views, listed

# A list of Camera, an Open3D PinholeCameraTrajectory or a pycolmap Reconstruction; of the last two, which are optional,
# nothing can be said here.
Cameras: TypeAlias = Sequence[Camera] | Any
# One a camera: arrays (H, W, 3), Pillow images or paths, in the order of the cameras or by camera name; or the
# folder that holds them.
Images: TypeAlias = Iterable[np.ndarray | str | Path] | Mapping[str, np.ndarray | str | Path] | str | Path
# A depth map (H, W), z-depth in scene units, or what loads it.
Depth: TypeAlias = np.ndarray | Loads
NO_DEPTH = ("no view has a depth map with a valid pixel: nothing to refine (of a mesh: it is too small to show; is it "
            "in another unit than the cameras? 'pagas-cl check' finds out by the photos)")
_CAMERAS = ("a list of pagas_cl.Camera (see its from_... constructors; read_scene(folder) has those of a "
            "folder) or Open3D PinholeCameraParameters, an Open3D PinholeCameraTrajectory or a pycolmap Reconstruction")


def as_cameras(cams: Cameras) -> list[Camera]:
    """The list of Camera; of a reconstruction those of the images that have a pose, in the order of their names."""
    cams = getattr(cams, "parameters", cams)        # of Open3D's trajectory
    if hasattr(cams, "images") and hasattr(cams, "cameras") and not isinstance(cams, Scene):
        posed = [image for image in cams.images.values() if getattr(image, "has_pose", True)]
        images = sorted(posed, key=lambda image: image.name)
        return [Camera.from_colmap(cams.cameras[image.camera_id], image) for image in images]
    found = listed("cams", cams, _CAMERAS)
    for k, camera in enumerate(found):
        if hasattr(camera, "intrinsic") and hasattr(camera, "extrinsic"):
            found[k] = Camera.from_open3d(camera, name=f"{k:05d}")
        elif not isinstance(camera, Camera):
            swapped = isinstance(camera, (np.ndarray, str, Path, Image.Image))
            raise InputError(f"cams[{k}] is {kind_of(camera)}, expected {_CAMERAS}"
                             + ("; were cams and images swapped?" if swapped else ""))
    return found


def as_views(cams: Cameras, images: Images, masks: Images | None = None) -> list[View]:
    """One View a camera; a folder of images or masks holds files called as the cameras are, of masks also as a scene's
    (`name.jpg.png`, `name.png`)."""
    cameras = as_cameras(cams)
    if not cameras:
        raise InputError("no cameras were given, expected at least two")
    photos = _matched(images, cameras, "images")
    keep = [None] * len(cameras) if masks is None else _matched(masks, cameras, "masks")
    views = [View(camera, photo, mask, camera.name or f"{k:05d}")
             for k, (camera, photo, mask) in enumerate(zip(cameras, photos, keep))]
    if isinstance(masks, (str, Path)):
        check_masks(views, Path(masks))
    return views


def depth_maps(views: Sequence[View], depths: Sequence[Depth | npt.ArrayLike | None]) -> list[Any]:
    """Depth maps as arrays, one a view; what loads one, or None, unchanged. InputError also by a file's header."""
    views = checked_views("views", views)
    given = listed("depths", depths, "a list with an array (height, width) or None a view")
    check_one_each(given, len(views))
    found: list[Any] = []
    for k, (view, depth) in enumerate(zip(views, given)):
        if isinstance(depth, DepthSource):
            depth.check()
        as_it_is = depth is None or is_loaded_later(depth)
        found.append(depth if as_it_is else _numbers(depth, f"depths[{k}], the depth map of view {view.name!r},"))
    return found


def check_one_each(depths: Sequence[Any], views: int) -> None:
    """InputError where there are not as many depth maps as views."""
    if len(depths) != views:
        raise InputError(f"{len(depths)} depth maps were given for {views} views, expected one each (None where there "
                         "is none)")


def check_maps(cameras: Sequence[Camera], depths: Sequence[Any], who: str = "") -> None:
    """InputError where depth maps (or samples, or None), called `who`, are not one a camera, and of its size."""
    check_one_each(depths, len(cameras))
    for camera, depth in zip(cameras, depths):
        if depth is not None and (shape := tuple(depth.shape)) != camera.size.shape:
            size = f"{shape[1]} x {shape[0]}" if len(shape) == 2 else f"of shape {shape}"
            raise InputError(f"{who or f'depth map of {camera.name!r}'} is {size}, its camera says {camera.width} x "
                             f"{camera.height}: resize one of them (pagas_cl.scene.depthmap.resize_depth)")


def _numbers(depth: npt.ArrayLike, who: str) -> np.ndarray:
    values = as_array(depth, who, "(height, width)")
    if values.shape[2:] == (1,) and type(depth).__module__.startswith("open3d"):      # its tensor images are so
        values = values[..., 0]
    if values.ndim != 2 or values.dtype.kind == "b":
        raise InputError(f"{who} has shape {values.shape} and dtype {values.dtype}, expected (height, width) and "
                         "numbers: z-depth in scene units")
    most = np.finfo(np.float32).max     # where there is no surface some write infinity or NaN
    if -most <= values.min(initial=0) and values.max(initial=0) <= most:
        return values
    return np.where(np.abs(values) <= most, values, values.dtype.type(0))


def checked_depth(depth: npt.ArrayLike, view: View) -> np.ndarray:
    """The depth map as an array, of the view's size and with at least one valid pixel."""
    depth = _numbers(depth, f"depth map of view {view.name!r}")
    size = view.camera.height, view.camera.width
    if depth.shape != size:
        remedy = ("it is transposed, expected (height, width)" if depth.shape == size[::-1] else
                  "resize it with pagas_cl.scene.depthmap.resize_depth")
        raise InputError(f"depth map of view {view.name!r} has shape {depth.shape}, its photo {size}; {remedy}")
    if not any((np.isfinite(part) & (part > 0)).any() for part in (depth[::16, ::16], depth)):
        raise InputError(f"depth map of view {view.name!r} has no valid pixel (all are zero, negative or not finite); "
                         "expected z-depths in scene units")
    return depth


def depth_array(depth: Depth) -> np.ndarray:
    """The depth map itself, read where an object with load() stands for it."""
    return _numbers(depth.load(), "a depth map that was loaded") if isinstance(depth, Loads) else np.asarray(depth)


def with_depth(depths: Sequence[Depth | None]) -> list[int]:
    """Places of those depth maps that have a surface, or are loaded later."""
    return [k for k, depth in enumerate(depths)
            if depth is not None and (isinstance(depth, Loads) or np.any(np.asarray(depth) > 0))]


def requested_views(views: Sequence[View], depths: Sequence[Depth | None], names: Collection[str] | None) -> list[int]:
    """Places of the views called `names`; of all that have one of `depths` (see depth_maps) where names is None."""
    have = with_depth(depths)
    if names is None:
        if not have:
            raise InputError(NO_DEPTH)
        return have
    known, ordered = [view.name for view in views], sorted(names) if isinstance(names, (set, frozenset)) else names
    wanted = listed("names", ordered, "a list of names of views", str, "the name of a view")
    chosen = list(dict.fromkeys(place_of(name, known) for name in wanted))
    without = [known[k] for k in chosen if depths[k] is None]
    if without or not chosen:
        raise InputError((f"names has {short(without[0])}, a view without a depth map" if without else "names is empty")
                         + ", expected names of views that have one, or None for all of these")
    return chosen


def _in_folder(folder: Path, cameras: list[Camera], what: str) -> list[Path | None]:
    """The file of each camera; None where it has no mask."""
    if not folder.is_dir():
        raise InputError(f"{what}: {folder} is no folder; give a folder, a list in the order of the cameras, or a "
                         "dict by camera name")
    named = [folder / camera.name for camera in cameras]
    found = [path if isfile(path) else find_mask(folder, path, (".",), camera.name) if what == "masks" else None
             for path, camera in zip(named, cameras)]
    missing = [camera.name for path, camera in zip(found, cameras) if path is None]
    if len(missing) == len(cameras):
        raise InputError(f"{what}: {folder} has no file that is called as a camera is, such as "
                         f"{cameras[0].name!r}: give the cameras the files' names, or a list in their order")
    if missing and what == "images":
        raise InputError(f"images: {folder} lacks {len(missing)} of the {len(cameras)} photos, such as {missing[0]!r}: "
                         "copy them there, or leave out their cameras")
    return found


def _matched(given: Images, cameras: list[Camera], what: str) -> list[Any]:
    if isinstance(given, (str, Path)):
        return _in_folder(Path(given), cameras, what)
    if isinstance(given, Mapping):
        missing = [camera.name for camera in cameras if camera.name not in given]
        if missing:
            raise InputError(f"{what}: none for camera {missing[0]!r} ({len(missing)} of {len(cameras)} are missing), "
                             "expected one by each camera's name")
        return [given[camera.name] for camera in cameras]
    if isinstance(given, np.ndarray) and given.ndim < 4 and what == "images":
        raise InputError(f"{what} is one array of shape {given.shape}, expected one a camera, in a list")
    each = listed(what, given, "a list in the order of the cameras, a dict by camera name, or a folder")
    if len(each) != len(cameras):
        raise InputError(f"{len(each)} {what} were given for {len(cameras)} cameras, expected one each, "
                         "in the same order")
    for k, item in enumerate(each):
        if not (isinstance(item, (str, Path, Loads)) or _is_plane(item) or (item is None and what == "masks")):
            raise InputError(f"{what}[{k}] is {kind_of(item)}, expected an array (height, width, ...), a Pillow image "
                             "or a path" + ("; were cams and images swapped?" if isinstance(item, Camera) else ""))
    files = [Path(item).stem for item in each if isinstance(item, (str, Path))]
    called = [Path(camera.name).stem for camera in cameras]
    if files != called and sorted(files) == sorted(called):
        k = next(k for k, (file, name) in enumerate(zip(files, called)) if file != name)
        raise InputError(f"{what}[{k}] is {short(str(each[k]))} and camera {k} is called {short(cameras[k].name)}: "
                         f"expected {what} in the order of the cameras (a Reconstruction's are sorted by name), or a "
                         "dict by camera name")
    return each


def _is_plane(item: Any) -> bool:
    try:
        values = np.asarray(item)
    except ValueError:      # rows of different lengths
        return False
    except (TypeError, RuntimeError):      # a tensor on a GPU: whoever reads it passes on what it says
        return True
    return values.ndim >= 2 and values.dtype.kind in "fiub"
