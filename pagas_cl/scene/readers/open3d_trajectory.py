"""Open3D's camera trajectories: .json (PinholeCameraTrajectory) and .log with the intrinsics beside it.

Convention: .json holds world-to-camera matrices and intrinsics, both column by column; .log holds camera-to-world
matrices, row by row, and NO intrinsics: those come from a PinholeCameraIntrinsic .json in the same folder, and without
one the reader refuses (Open3D itself would silently take a PrimeSense camera). Open3D's legacy cameras count pixel
centres at whole numbers. Neither file names photos: the i-th camera is that of the i-th photo.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pagas_cl.errors import InputError
from pagas_cl.scene.camera import Camera, inverse_pose
from pagas_cl.scene.readers import photos, untrusted
from pagas_cl.scene.view import Scene

PIXEL_CENTER = 0.0
_LOGS = ("trajectory.log", "scene/trajectory.log", "camera.log")
_INTRINSICS = ("camera_intrinsic.json", "intrinsic.json", "intrinsics.json", "camera.json")
_MARK = b'"PinholeCameraTrajectory"'


def detect(folder: Path) -> bool:
    """Whether `folder` holds a trajectory of Open3D."""
    return bool(_trajectories(Path(folder)))


def _trajectories(folder: Path) -> list[Path]:
    found = []
    for path in sorted(folder.glob("*.json")):
        try:
            if path.stat().st_size <= untrusted.MAX_BYTES and _MARK in path.read_bytes():
                found.append(path)
        except OSError:
            continue
    return found or [folder / name for name in _LOGS if (folder / name).is_file()][:1]


def read(folder: Path, *, pixel_center: float = PIXEL_CENTER) -> Scene:
    """Read the scene; `pixel_center`: where the intrinsics put the centre of the top-left pixel."""
    folder = Path(folder)
    files = _trajectories(folder)
    if not files:
        raise InputError(f"{folder} has no PinholeCameraTrajectory .json and none of {', '.join(_LOGS)}")
    if len(files) > 1:
        raise InputError(f"{folder} has several trajectories ({', '.join(p.name for p in files[:5])}); keep one")
    path = files[0]
    if path.suffix == ".json":
        cameras = read_json(path, pixel_center=pixel_center)
    else:
        poses = read_log(path)
        size, K = read_intrinsic(_intrinsic_file(folder, path))
        cameras = [untrusted.pinhole(K, pose, *size, f"camera {i}", pixel_center=pixel_center)
                   for i, pose in enumerate(poses)]
    images = photos.one_photo_each(photos.scene_photos(folder), len(cameras), str(path))
    return Scene(views=[photos.view_of(folder, replace(camera, name=photo.name), photo)
                        for camera, photo in zip(cameras, images)],
                 source=f"{path} (Open3D)")


def _intrinsic_file(folder: Path, log: Path) -> Path:
    for path in [place / name for place in (log.parent, folder) for name in _INTRINSICS]:
        if path.is_file():
            return path
    raise InputError(f"{log} has poses but no intrinsics (Open3D's .log drops them): put {_INTRINSICS[0]} beside it "
                     "(o3d.io.write_pinhole_camera_intrinsic), or write the trajectory as .json")


def read_json(path: Path, *, pixel_center: float = PIXEL_CENTER) -> list[Camera]:
    """Cameras of a PinholeCameraTrajectory .json."""
    data = untrusted.read_json(Path(path))
    if data.get("class_name") != "PinholeCameraTrajectory":
        raise InputError(f"{path}: class_name is {untrusted.short(data.get('class_name'))}, expected "
                         "'PinholeCameraTrajectory'")
    entries = data.get("parameters")
    if not isinstance(entries, list) or not entries:
        raise InputError(f"{path}: 'parameters' is {untrusted.short(entries)}, expected a list with one camera a photo")
    return [_camera(entry, f"{path}, camera {i}", i, pixel_center) for i, entry in enumerate(entries)]


def _camera(entry: Any, where: str, number: int, pixel_center: float) -> Camera:
    if not isinstance(entry, dict):
        raise InputError(f"{where} is {untrusted.short(entry)}, expected an object")
    pose = _columns(entry.get("extrinsic"), 4, f"{where}: extrinsic")
    size, K = _intrinsic(entry.get("intrinsic"), f"{where}: intrinsic")
    return untrusted.pinhole(K, pose, *size, f"camera {number}", pixel_center=pixel_center)


def read_intrinsic(path: Path) -> tuple[tuple[int, int], np.ndarray]:
    """(width, height) and K (3, 3) of a PinholeCameraIntrinsic .json, as the file has them."""
    return _intrinsic(untrusted.read_json(Path(path)), str(path))


def _intrinsic(value: Any, where: str) -> tuple[tuple[int, int], np.ndarray]:
    if not isinstance(value, dict):
        raise InputError(f"{where} is {untrusted.short(value)}, expected an object with width, height and "
                         "intrinsic_matrix")
    width, height = (untrusted.whole(value.get(side), 1, untrusted.MAX_SIDE, f"{where}: {side}")
                     for side in ("width", "height"))
    return (width, height), _columns(value.get("intrinsic_matrix"), 3, f"{where}: intrinsic_matrix")


def _columns(values: Any, side: int, what: str) -> np.ndarray:
    """A square matrix that JSON holds as one list, column by column."""
    if not isinstance(values, list) or len(values) != side * side:
        raise InputError(f"{what} is {untrusted.short(values)}, expected {side * side} numbers")
    return np.array([untrusted.number(v, what) for v in values], np.float64).reshape(side, side).T


def read_log(path: Path) -> list[np.ndarray]:
    """World-to-camera poses (4, 4) of a .log trajectory: for each camera three whole numbers and a 4x4 matrix."""
    lines = [line.split() for line in untrusted.read_text(Path(path)).splitlines() if line.strip()]
    if not lines or len(lines) % 5:
        raise InputError(f"{path} has {len(lines)} lines that are not empty, expected 5 for each camera: is the file "
                         "cut off?")
    poses = []
    for start in range(0, len(lines), 5):
        where = f"{path}, camera {start // 5}"
        head, rows = lines[start], lines[start + 1:start + 5]
        if len(head) != 3 or any(len(row) != 4 for row in rows):
            raise InputError(f"{where}: expected a line of 3 numbers and 4 lines of 4")
        untrusted.words(head, f"{where}: head")
        c2w = np.array([untrusted.words(row, f"{where}: pose") for row in rows])
        K = np.eye(3)
        poses.append(inverse_pose(untrusted.pinhole(K, c2w, 1, 1, where).world_to_camera))  # checks that it is rigid
    return poses


def write_json(path: Path, cameras: list[Camera], *, pixel_center: float = PIXEL_CENTER) -> Path:
    """Write a PinholeCameraTrajectory .json that Open3D reads; every camera keeps all its digits."""
    entries = []
    for camera in cameras:
        entries.append({"class_name": "PinholeCameraParameters", "version_major": 1, "version_minor": 0,
                        "extrinsic": camera.world_to_camera.T.ravel().tolist(),
                        "intrinsic": _intrinsic_entry(camera, pixel_center)})
    data = {"class_name": "PinholeCameraTrajectory", "version_major": 1, "version_minor": 0, "parameters": entries}
    return untrusted.write_text(Path(path), json.dumps(data, indent=1))


def _intrinsic_entry(camera: Camera, pixel_center: float) -> dict[str, Any]:
    K = camera.K
    K[:2, 2] += pixel_center - 0.5
    return {"width": camera.width, "height": camera.height, "intrinsic_matrix": K.T.ravel().tolist()}


def write_log(path: Path, cameras: list[Camera], *, pixel_center: float = PIXEL_CENTER) -> Path:
    """Write a .log trajectory, and the intrinsics, which it cannot hold, as camera_intrinsic.json beside it.

    InputError where the cameras differ in size or intrinsics: the layout has one set for all.
    """
    path = Path(path)
    entries = [_intrinsic_entry(camera, pixel_center) for camera in cameras]
    if not entries or any(entry != entries[0] for entry in entries):
        raise InputError(f"{path}: a .log has one set of intrinsics for all its {len(entries)} cameras, and these "
                         "differ; write a .json")
    rows = []
    for number, camera in enumerate(cameras):
        rows.append(f"{number} {number} {number + 1}")
        rows += [" ".join(repr(float(v)) for v in row) for row in inverse_pose(camera.world_to_camera)]
    untrusted.write_text(path.with_name(_INTRINSICS[0]), json.dumps(entries[0], indent=1))
    return untrusted.write_text(path, "\n".join(rows) + "\n")
