"""nerfstudio's and instant-ngp's transforms.json, and the synthetic scenes of NeRF (transforms_train.json).

Convention: camera-to-world, OpenGL axes (x right, y up, looking along -z); rays go through pixel centres at +0.5.
`applied_transform` says how the file's world came from another one and is not undone: cameras, points and meshes share
the file's world. Depth maps (`depth_file_path` of a frame) are z-depth times `depth_unit_scale_factor` (0.001 where it
is not given); NerfCapture says `depth_path`, `integer_depth_scale`.
"""

import math
from pathlib import Path
from typing import Any

import numpy as np

from pagas_cl.errors import InputError, log, short
from pagas_cl.scene import untrusted
from pagas_cl.scene.camera import FLIP, intrinsics
from pagas_cl.scene.depth.source import DepthSource
from pagas_cl.scene.readers import photos
from pagas_cl.scene.view import Scene, View

FILES = ("transforms.json", "transforms_train.json")
EXPECTED = " or ".join(FILES)
_PINHOLE = ("fl_x", "fl_y", "cx", "cy")
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
_KNOWN = _PINHOLE + _DISTORTION + ("w", "h", "camera_angle_x", "camera_angle_y", "camera_model", "frames",
                                   "file_path", "transform_matrix", "mask_path", "depth_file_path", "is_fisheye",
                                   "depth_path", "depth_unit_scale_factor", "integer_depth_scale", "distortion_params")
_DEPTH = (("depth_file_path", "depth_unit_scale_factor"), ("depth_path", "integer_depth_scale"))
_DEPTH_UNIT = 1e-3      # nerfstudio's where the file does not say
_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")


def detect(folder: Path) -> Path | None:
    return photos.first_file(folder, FILES)


def read(folder: Path, path: Path, *, outside: bool = False) -> Scene:
    """Read the scene; `outside`: whether photos and masks outside `folder` may be read."""
    data = untrusted.read_json(path)
    untrusted.refuse_near_misses(data, _KNOWN, str(path))
    frames = untrusted.objects(data, "frames", "frame", path, _KNOWN)
    files = [_photo(folder, frame.get("file_path"), f"{where}: file_path", outside) for frame, where in frames]
    views = [_view(folder, data, frame, where, photo, name, outside)
             for (frame, where), photo, name in zip(frames, files, photos.names_of(files))]
    depths = [_depth(folder, data, frame, where, view, outside) for (frame, where), view in zip(frames, views)]
    if "applied_transform" in data:
        log.info("%s: cameras are kept in the file's world; its applied_transform is not undone", path)
    if not any(depths):
        return Scene(views=views, source=str(path))
    unit = next(f"{depth.scale:g} for one scene unit" for depth in depths if depth is not None)
    known = any(key in values for _, key in _DEPTH for values in (data, *(frame for frame, _ in frames)))
    return Scene(views=views, source=str(path), depths=tuple(depths),
                 depth_unit=f"{unit}, as the file says" if known else f"{unit}, nerfstudio's default")


def _depth(folder: Path, data: dict[str, Any], frame: dict[str, Any], where: str, view: View,
           outside: bool) -> DepthSource | None:
    values = {**data, **frame}
    for name, unit in _DEPTH:
        if frame.get(name) is not None:
            path = photos.named(folder, frame[name], f"{where}: {name}", outside)
            factor = untrusted.number(values.get(unit, _DEPTH_UNIT), f"{where}: {unit}")
            if not 1e-12 < factor < 1e12:
                raise InputError(f"{where}: {unit} is {factor:g}, expected a number above 0")
            return DepthSource(path, (view.camera.width, view.camera.height), 1 / factor)
    return None


def _view(folder: Path, data: dict[str, Any], frame: dict[str, Any], where: str, photo: Path, name: str,
          outside: bool) -> View:
    values = {**data, **frame}
    _refuse_distortion(values, where)
    if ("w" in values) != ("h" in values):
        raise InputError(f"{where}: only one of w and h is given; give both or neither")
    given = "w" in values
    width, height = untrusted.size(values["w"], values["h"], where) if given else photos.photo_size(photo)
    c2w = untrusted.matrix(frame.get("transform_matrix"), 4, 4, f"{where}: transform_matrix")
    if np.abs(c2w[3] - [0, 0, 0, 1]).max() > 1e-9:
        raise InputError(f"{where}: the last row of transform_matrix is {c2w[3].tolist()}, expected [0, 0, 0, 1]")
    camera = untrusted.pinhole(_intrinsics(values, width, height, where), c2w @ FLIP, width, height, name,
                               camera_to_world=True)
    mask = frame.get("mask_path")
    if mask is not None:
        mask = photos.named(folder, mask, f"{where}: mask_path", outside)
    return photos.view_of(folder, camera, photo, mask, name)


def _photo(folder: Path, name: Any, what: str, outside: bool) -> Path:
    photo = untrusted.inside(folder, name, what, outside=outside)
    if not photo.suffix:  # NeRF's synthetic scenes leave the suffix out
        photo = photos.first_file(photo.parent, (photo.name + s for s in untrusted.IMAGE_SUFFIXES)) or photo
    return photos.existing(photo, what)


def _refuse_distortion(values: dict[str, Any], where: str) -> None:
    model = values.get("camera_model", "PINHOLE")
    if model not in _MODELS or values.get("is_fisheye"):
        key = "is_fisheye" if values.get("is_fisheye") else "camera_model"
        raise InputError(f"{where}: {key} is {short(values[key])}, expected camera_model {' or '.join(_MODELS)} with "
                         "all distortion 0; undistort the photos first")
    given = [(key, untrusted.number(values[key], f"{where}: {key}")) for key in _DISTORTION if key in values]
    if "distortion_params" in values:       # nerfstudio takes them in place of the single ones
        key, six = "distortion_params", values["distortion_params"]
        given += [(key, number) for number in untrusted.numbers(six, len(_DISTORTION), f"{where}: {key}")]
    for key, number in given:
        if number != 0:
            raise InputError(f"{where}: {key} is {short(values[key])}, expected 0: photos must be undistorted first "
                             "(colmap image_undistorter)")


def _intrinsics(values: dict[str, Any], width: int, height: int, where: str) -> np.ndarray:
    given = [key for key in _PINHOLE if key in values]
    if given and len(given) < 4:
        absent = next(key for key in _PINHOLE if key not in values)
        raise InputError(f"{where}: {', '.join(given)} given and {absent} absent; fl_x, fl_y, cx and cy go together")
    if given:
        fx, fy, cx, cy = (untrusted.number(values[key], f"{where}: {key}") for key in _PINHOLE)
    elif "camera_angle_x" in values:
        fx = _focal(values, "camera_angle_x", width, where)
        fy = _focal(values, "camera_angle_y", height, where) if "camera_angle_y" in values else fx
        cx, cy = width / 2, height / 2
    else:
        raise InputError(f"{where}: no intrinsics: expected fl_x, fl_y, cx and cy, or camera_angle_x")
    return intrinsics(fx, fy, cx, cy)


def _focal(values: dict[str, Any], key: str, side: int, where: str) -> float:
    angle = untrusted.number(values[key], f"{where}: {key}")
    if not 0 < angle < math.pi:
        raise InputError(f"{where}: {key} is {angle:g}, expected radians between 0 and pi")
    return side / 2 / math.tan(angle / 2)
