"""Cameras written as the formats that we only read hold them, every digit kept; what a format cannot hold is refused.

(cameras.json and MeshLab projects are written by the package itself.)
"""

import json
import re
from pathlib import Path

import numpy as np

from pagas_cl.errors import InputError
from pagas_cl.scene.camera import inverse_pose

_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def _row(values):
    return " ".join(repr(float(value)) for value in values)


def bundler(folder, views):
    """bundle.out and list.txt: one focal length, the principal point in the middle."""
    rows, names = ["# Bundle file v0.3", f"{len(views)} 0"], []
    for view in views:
        camera = view.camera
        if max(abs(camera.cx - camera.width / 2), abs(camera.cy - camera.height / 2)) > 1e-9 * camera.width:
            raise InputError(f"view {view.name!r}: the principal point ({camera.cx:g}, {camera.cy:g}) is not the "
                             "photo's middle, and Bundler's format cannot hold it; write another format")
        if abs(camera.fx - camera.fy) > 1e-9 * camera.fx:
            raise InputError(f"view {view.name!r}: fx {camera.fx!r} and fy {camera.fy!r} differ, and Bundler's format "
                             "holds one focal length; write another format")
        pose = (_FLIP @ camera.world_to_camera)[:3]
        rows += [f"{camera.fx!r} 0 0", *(_row(row) for row in (*pose[:, :3], pose[:, 3]))]
        names.append(view.image.relative_to(folder).as_posix())
    (folder / "list.txt").write_text("\n".join(names) + "\n")
    (folder / "bundle.out").write_text("\n".join(rows) + "\n")


def mvsnet(folder, views, depth_range=(0.0, 0.0)):
    """cams/NNNNNNNN_cam.txt for photos that are called by numbers."""
    place = Path(folder) / "cams"
    place.mkdir(parents=True, exist_ok=True)
    for view in views:
        if not re.fullmatch(r"\d+", view.stem, re.ASCII):
            raise InputError(f"view {view.name!r}: MVSNet's files are called by numbers, such as 00000007.png")
        rows = ["extrinsic", *(_row(row) for row in view.camera.world_to_camera), "", "intrinsic",
                *(_row(row) for row in view.camera.K), "", _row(depth_range), ""]
        (place / f"{int(view.stem):08d}_cam.txt").write_text("\n".join(rows))


def nerfstudio(folder, views):
    """transforms.json."""
    frames = []
    for view in views:
        camera = view.camera
        frames.append({"file_path": view.image.relative_to(folder).as_posix(), "w": camera.width, "h": camera.height,
                       "fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy,
                       "transform_matrix": (inverse_pose(camera.world_to_camera) @ _FLIP).tolist()})
    text = json.dumps({"camera_model": "PINHOLE", "frames": frames}, indent=1)
    (Path(folder) / "transforms.json").write_text(text)


def neus(folder, views, scale_mat=None):
    """cameras.npz, view i as number i; `scale_mat` (4, 4) takes the unit sphere to the world."""
    arrays = {}
    for number, view in enumerate(views):
        K = np.eye(4)
        K[:3, :3] = view.camera.K
        arrays[f"world_mat_{number}"] = K @ view.camera.world_to_camera
        arrays[f"scale_mat_{number}"] = np.eye(4) if scale_mat is None else scale_mat
    np.savez(Path(folder) / "cameras.npz", **arrays)


def open3d_json(path, cameras):
    """A PinholeCameraTrajectory."""
    entries = [{"class_name": "PinholeCameraParameters", "version_major": 1, "version_minor": 0,
                "extrinsic": camera.world_to_camera.T.ravel().tolist(), "intrinsic": _intrinsic(camera)}
               for camera in cameras]
    data = {"class_name": "PinholeCameraTrajectory", "version_major": 1, "version_minor": 0, "parameters": entries}
    path.write_text(json.dumps(data, indent=1))


def open3d_log(path, cameras):
    """A .log trajectory, and the intrinsics, which it cannot hold, as camera_intrinsic.json beside it."""
    entries = [_intrinsic(camera) for camera in cameras]
    if any(entry != entries[0] for entry in entries):
        raise InputError(f"{path}: a .log has one set of intrinsics for all its {len(entries)} cameras, and these "
                         "differ; write a .json")
    rows = []
    for number, camera in enumerate(cameras):
        rows += [f"{number} {number} {number + 1}", *(_row(row) for row in inverse_pose(camera.world_to_camera))]
    path.with_name("camera_intrinsic.json").write_text(json.dumps(entries[0], indent=1))
    path.write_text("\n".join(rows) + "\n")


def _intrinsic(camera):
    """Open3D counts pixel centres at whole numbers."""
    K = camera.K
    K[:2, 2] -= 0.5
    return {"width": camera.width, "height": camera.height, "intrinsic_matrix": K.T.ravel().tolist()}
