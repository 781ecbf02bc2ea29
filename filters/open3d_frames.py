"""Open3D's RGB-D frames, in any of the forms in which people hold them, as views and depth maps, and back."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from pagas_cl.errors import InputError, kind_of, need
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.depthmap import clean_depth
from pagas_cl.scene.images import as_photo, open_image, read_photo
from pagas_cl.scene.view import View


@dataclass(frozen=True, eq=False)
class Frame:
    view: View
    depth: np.ndarray   # scene units, 0 = none
    given: Any
    scale: float        # what divides its depth numbers


def read_frames(frames, intrinsics, extrinsics=None, *, depth_scale=None, depth_trunc=None,
                pixel_center=0.0) -> list[Frame]:
    """Frames with their cameras; parameters as in open3d_pipeline.refine_rgbd."""
    frames = _listed(frames, "frames", "a list of RGBDImage or of pairs (color, depth)")
    if not frames:
        raise InputError("no frames were given, expected a list of RGBDImage or of pairs (color, depth)")
    for name, value in (("depth_scale", depth_scale), ("depth_trunc", depth_trunc)):
        if value is not None and not above_zero(value):
            raise InputError(f"{name} is {value!r}, expected a number above 0")
    read = [_read(frame, f"{k:05d}") for k, frame in enumerate(frames)]
    cameras = read_cameras(intrinsics, extrinsics, [raw.shape[::-1] for _, raw in read], pixel_center=pixel_center)
    return [_frame(given, *parts, camera, depth_scale, depth_trunc)
            for given, parts, camera in zip(frames, read, cameras)]


def above_zero(value) -> bool:
    """Whether a value is a finite number above 0."""
    return isinstance(value, (int, float, np.number)) and bool(np.isfinite(value)) and value > 0


def _listed(values, what: str, expected: str) -> list:
    """The list of what can be gone through; arrays by their first axis."""
    if isinstance(values, (str, Path)) or not hasattr(values, "__iter__"):
        raise InputError(f"{what} is {kind_of(values)}, expected {expected}: are the arguments in the order "
                         "(frames, intrinsics, extrinsics)?")
    return list(values)


def _read(given, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Photo and depth numbers of a frame, which must be of one size."""
    color, depth = _parts(given)
    raw = _pixels(depth, f"depth of frame {name}")
    if raw.ndim != 2:
        raise InputError(f"depth of frame {name} has shape {raw.shape}, expected (height, width): is the pair (color, "
                         "depth) in this order?")
    photo = _photo(color, f"color of frame {name}")
    if photo.shape[:2] != raw.shape:
        raise InputError(f"frame {name}: color is {photo.shape[1]} x {photo.shape[0]} and depth {raw.shape[1]} x "
                         f"{raw.shape[0]}; register the depth to the color first")
    return photo, raw


def _photo(color, who: str) -> np.ndarray:
    if isinstance(color, (str, Path)):
        return read_photo(color)
    if isinstance(color, Image.Image):
        return as_photo(color.convert("RGB"), who)      # a palette is no colour
    pixels = _pixels(color, who)
    if pixels.dtype.kind == "f" and pixels.max(initial=0) < 1.01:
        pixels = np.clip(pixels, 0, 1)    # floating point colours as Open3D makes them can pass 1 by rounding
    return as_photo(pixels, who)


def _frame(given, photo, raw, camera: Camera, depth_scale, depth_trunc) -> Frame:
    is_legacy = not isinstance(given, (tuple, list)) and ".t." not in type(given).__module__
    if is_legacy and depth_scale not in (None, 1, 1.0):
        raise InputError(f"frame {camera.name}: depth_scale is {depth_scale:g}, but an RGBDImage already holds scene "
                         "units: create_from_color_and_depth has divided its depth; leave depth_scale out")
    if depth_scale is None:
        depth_scale = 1000.0 if raw.dtype.kind in "ui" else 1.0
    depth = clean_depth(raw.astype(np.float64) / depth_scale, f"depth of frame {camera.name}")
    if depth_trunc is not None:
        depth = np.where(depth < depth_trunc, depth, np.float32(0))  # as Open3D: what reaches it is dropped
    return Frame(View(camera, photo, None, camera.name), depth, given, float(depth_scale))


def _parts(given) -> tuple:
    if isinstance(given, (tuple, list)):
        if len(given) != 2:
            raise InputError(f"a frame has {len(given)} parts, expected a pair (color, depth) or an RGBDImage")
        return tuple(given)
    if not (hasattr(given, "color") and hasattr(given, "depth")):
        raise InputError(f"a frame is {kind_of(given)}, expected an Open3D RGBDImage (legacy or tensor) or a "
                         "pair (color, depth)")
    return given.color, given.depth


def _pixels(image, who: str) -> np.ndarray:
    """(H, W) or (H, W, C) array of a legacy or tensor Image, one of Pillow, an array, or a file."""
    if isinstance(image, (str, Path)):
        with open_image(Path(image)) as file:
            return _pixels(file, who)
    if hasattr(image, "is_empty") and image.is_empty():
        raise InputError(f"{who} is empty, as Open3D makes images of files that it cannot read: is its path right?")
    pixels = np.asarray(as_numpy(image))
    if isinstance(image, Image.Image) and pixels.dtype == np.int32:      # how Pillow may open 16-bit files
        pixels = pixels.astype(np.uint16)
    if pixels.ndim == 3 and pixels.shape[2] == 1:
        pixels = pixels[..., 0]
    if pixels.ndim not in (2, 3) or pixels.size == 0 or pixels.dtype.kind not in "uif":
        raise InputError(f"{who} has shape {pixels.shape} and dtype {pixels.dtype}, expected an image")
    return pixels


def as_numpy(value) -> np.ndarray:
    """A legacy or tensor Image, a tensor, or what NumPy knows, as an array."""
    if hasattr(value, "as_tensor"):
        value = value.as_tensor()
    return value.cpu().numpy() if hasattr(value, "cpu") else np.asarray(value)


def read_cameras(intrinsics, extrinsics, sizes, *, pixel_center: float = 0.0) -> list[Camera]:
    """Cameras of Open3D's intrinsics (one for all, or a list) and world-to-camera extrinsics, or of a trajectory, or a
    list of PinholeCameraParameters, alone.

    Parameters as in open3d_pipeline.refine_rgbd; `sizes` are (width, height) of the frames.
    """
    count = len(sizes)
    each = intrinsics.parameters if hasattr(intrinsics, "parameters") else intrinsics
    several = 1 if hasattr(each, "extrinsic") else count
    each = list(each) if isinstance(each, (list, tuple)) else [each] * several
    if any(hasattr(entry, "extrinsic") for entry in each):
        if extrinsics is not None:
            raise InputError("PinholeCameraParameters, as in a trajectory, bring their own extrinsics; leave them out")
        if not all(hasattr(entry, "extrinsic") for entry in each):
            raise InputError("intrinsics mix PinholeCameraParameters with others, expected one kind")
        each, extrinsics = [entry.intrinsic for entry in each], [entry.extrinsic for entry in each]
    if extrinsics is None:
        raise InputError(f"extrinsics are missing and intrinsics is {kind_of(intrinsics)}: give one world-to-camera "
                         "matrix a frame, or a trajectory alone (o3d.io.read_pinhole_camera_trajectory reads one)")
    extrinsics = _listed(extrinsics, "extrinsics", "a list of world-to-camera matrices (4, 4)")
    for what, got in (("intrinsics", each), ("extrinsics", extrinsics)):
        if len(got) != count:
            raise InputError(f"{len(got)} {what} were given for {count} frames, expected one each, in the same order")
    return [_camera(K, E, size, f"{k:05d}", pixel_center)
            for k, (K, E, size) in enumerate(zip(each, extrinsics, sizes))]


def _camera(intrinsic, extrinsic, size, name: str, pixel_center: float) -> Camera:
    if hasattr(intrinsic, "intrinsic_matrix"):
        said = (intrinsic.width, intrinsic.height)
        if said != tuple(size) and min(said) > 0:
            raise InputError(f"frame {name} is {size[0]} x {size[1]}, its intrinsics say {said[0]} x {said[1]}: scale "
                             "the intrinsics, or take those of this size")
        intrinsic = intrinsic.intrinsic_matrix
    try:
        K, E = (np.asarray(as_numpy(value), np.float64) for value in (intrinsic, extrinsic))
    except (TypeError, ValueError) as error:
        raise InputError(f"frame {name}: its intrinsic is {kind_of(intrinsic)} and its extrinsic "
                         f"{kind_of(extrinsic)}, expected matrices (3, 3) and (4, 4), or PinholeCameraIntrinsic "
                         "for the first: are the arguments in the order (frames, intrinsics, extrinsics)?") from error
    if K.shape == (4, 4) and E.shape == (3, 3):
        raise InputError(f"frame {name}: its intrinsic has shape (4, 4) and its extrinsic (3, 3), expected the other "
                         "way round: are the arguments in the order (frames, intrinsics, extrinsics)?")
    return Camera.from_opencv_w2c(K, E, *size, pixel_center=pixel_center, name=name)


def give_back(frame: Frame, depth: np.ndarray):
    """A frame of the form that came in with another depth, float32 in the numbers that came in (times its scale).

    Colours stay as they are, but for tensors, which become float32 from 0 to 1: VoxelBlockGrid takes floating point
    depth only together with floating point colours.
    """
    raw = np.ascontiguousarray(depth * np.float32(frame.scale), np.float32)
    color, given = _parts(frame.given)
    is_pair, is_tensor = isinstance(frame.given, (tuple, list)), hasattr(given, "as_tensor")
    if is_pair and "open3d" not in type(given).__module__:
        return type(frame.given)((color, Image.fromarray(raw) if isinstance(given, Image.Image) else raw))
    o3d = need("open3d", "mesh", "RGB-D frames")
    if is_tensor:
        made = o3d.t.geometry.Image(o3d.core.Tensor(raw[..., None]))
        if hasattr(color, "as_tensor"):
            pixels = as_numpy(color)
            full = np.iinfo(pixels.dtype).max if pixels.dtype.kind in "iu" else 1
            pixels = np.ascontiguousarray(pixels.astype(np.float32) / full, np.float32)
            color = o3d.t.geometry.Image(o3d.core.Tensor(pixels))
    else:
        made = o3d.geometry.Image(raw)
    if is_pair:
        return type(frame.given)((color, made))
    if is_tensor:
        return o3d.t.geometry.RGBDImage(color, made)
    new = o3d.geometry.RGBDImage()
    new.color, new.depth = color, made
    return new
