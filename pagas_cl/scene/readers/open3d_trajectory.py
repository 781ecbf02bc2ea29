"""Open3D's camera trajectories: .json (PinholeCameraTrajectory) and .log with the intrinsics next to it.

Convention: .json holds world-to-camera matrices and intrinsics, both column by column; .log holds camera-to-world
matrices, row by row, and NO intrinsics: those come from a PinholeCameraIntrinsic .json in the same folder, and without
one the reader refuses (Open3D itself would silently take a PrimeSense camera). Open3D's legacy cameras count pixel
centres at whole numbers. Neither file names photos: the i-th camera is that of the i-th photo. Depth maps in depth/ are
16-bit PNG, with the depth_scale of a recording's intrinsics .json (4000 of some sensors), else 1000 for one unit.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pagas_cl.errors import InputError, log, short
from pagas_cl.scene import untrusted
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.depth.source import DepthSource
from pagas_cl.scene.readers import photos
from pagas_cl.scene.view import Scene, View

PIXEL_CENTER = 0.0
DEPTH_SCALE = 1000.0
_LOGS = ("trajectory.log", "scene/trajectory.log", "camera.log")
EXPECTED = f"PinholeCameraTrajectory .json and none of {', '.join(_LOGS)}"
_INTRINSICS = ("camera_intrinsic.json", "intrinsic.json", "intrinsics.json", "camera.json")
_MARK = b'"PinholeCameraTrajectory"'


def detect(folder: Path) -> list[Path]:
    found = [path for path in sorted(folder.glob("*.json")) if untrusted.holds(path, _MARK)]
    return found or [folder / name for name in _LOGS if (folder / name).is_file()][:1]


def read(folder: Path, files: list[Path], *, pixel_center: float = PIXEL_CENTER) -> Scene:
    """Read the scene; `pixel_center`: where the intrinsics put the centre of the top-left pixel."""
    if len(files) > 1:
        raise InputError(f"{folder} has several trajectories ({', '.join(p.name for p in files[:5])}); keep one")
    path = files[0]
    intrinsic = photos.first_file(path.parent, _INTRINSICS) or photos.first_file(folder, _INTRINSICS)
    if path.suffix == ".json":
        cameras = read_json(path, pixel_center=pixel_center)
    else:
        if intrinsic is None:
            raise InputError(f"{path} has poses but no intrinsics (Open3D's .log drops them): put {_INTRINSICS[0]} "
                             "next to it (o3d.io.write_pinhole_camera_intrinsic), or write the trajectory as .json")
        size, K = _intrinsic(untrusted.read_json(intrinsic), str(intrinsic))
        cameras = [untrusted.pinhole(K, pose, *size, f"{path}, camera {i}", pixel_center=pixel_center,
                                     camera_to_world=True) for i, pose in enumerate(read_log(path))]
    images = photos.one_photo_each(photos.scene_photos(folder), len(cameras), str(path))
    views = [photos.view_of(folder, replace(camera, name=photo.name), photo) for camera, photo in zip(cameras, images)]
    scale, origin = DEPTH_SCALE, "Open3D's default"
    if intrinsic is not None and untrusted.holds(intrinsic, b'"depth_scale"'):     # as Open3D's recordings have it
        scale = untrusted.number(untrusted.read_json(intrinsic).get("depth_scale"), f"{intrinsic}: depth_scale")
        origin = f"as {intrinsic.name} says"
    depths = _depths(folder, views, scale)
    return Scene(views, f"{path} (Open3D)", depths=depths,
                 depth_unit="" if depths is None else f"{scale:g} for one scene unit, {origin}")


def _depths(folder: Path, views: list[View], scale: float) -> tuple[DepthSource | None, ...] | None:
    """By name, else in order where there are as many; None without."""
    found = [path for path in photos.list_photos(folder / "depth") if path.suffix.lower() == ".png"]
    by_stem = {path.stem: path for path in found}
    files: list[Path | None] = [by_stem.get(view.stem) for view in views]
    if not any(files) and len(found) == len(views):
        files = list(found)
    elif not any(files) and found:
        log.warning("%s has %d depth maps, none called as one of the %d photos is: they are not used",
                    folder / "depth", len(found), len(views))
    return tuple(None if file is None else DepthSource(file, (view.camera.width, view.camera.height), scale)
                 for file, view in zip(files, views)) if any(files) else None


def read_json(path: Path, *, pixel_center: float = PIXEL_CENTER) -> list[Camera]:
    """Cameras of a PinholeCameraTrajectory .json."""
    data = untrusted.read_json(path)
    if data.get("class_name") != "PinholeCameraTrajectory":
        raise InputError(f"{path}: class_name is {short(data.get('class_name'))}, expected "
                         "'PinholeCameraTrajectory'")
    cameras = []
    for i, (entry, where) in enumerate(untrusted.objects(data, "parameters", "camera", path)):
        pose = untrusted.numbers(entry.get("extrinsic"), 16, f"{where}: extrinsic").reshape(4, 4).T
        size, K = _intrinsic(entry.get("intrinsic"), f"{where}: intrinsic")
        cameras.append(untrusted.pinhole(K, pose, *size, f"camera {i}", pixel_center=pixel_center))
    return cameras


def _intrinsic(value: Any, where: str) -> tuple[tuple[int, int], np.ndarray]:
    if not isinstance(value, dict):
        raise InputError(f"{where} is {short(value)}, expected an object with width, height and intrinsic_matrix")
    size = untrusted.size(value.get("width"), value.get("height"), where)
    K = untrusted.numbers(value.get("intrinsic_matrix"), 9, f"{where}: intrinsic_matrix")
    return size, K.reshape(3, 3).T


def read_log(path: Path) -> list[np.ndarray]:
    """Camera-to-world poses (4, 4) of a .log trajectory: for each camera three whole numbers and a 4x4 matrix."""
    lines = [line.split() for line in untrusted.read_text(path).splitlines() if line.strip()]
    if not lines or len(lines) % 5:
        raise InputError(f"{path} has {len(lines)} lines that are not empty, expected 5 for each camera: is the file "
                         "cut off?")
    poses = []
    for start in range(0, len(lines), 5):
        where = f"{path}, camera {start // 5}"
        untrusted.floats(lines[start], f"{where}: head", 3)
        poses.append(np.array([untrusted.floats(row, f"{where}: pose", 4) for row in lines[start + 1:start + 5]]))
    return poses
