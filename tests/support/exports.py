"""Cameras written as the formats that we read hold them, every digit kept; what a format cannot hold is refused.

cameras.json and MeshLab projects have writers of their own in the package. Formats with depth maps: exports_depth,
exports_rgbd.
"""

import json
import re
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pagas_cl.errors import InputError
from pagas_cl.scene.camera import FLIP, Camera, inverse_pose
from pagas_cl.scene.readers.meshlab import row
from pagas_cl.scene.readers.photos import file_of
from pagas_cl.scene.view import View


def bundler(folder: Path, views: Sequence[View]) -> None:
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
        pose = (FLIP @ camera.world_to_camera)[:3]
        rows += [f"{camera.fx!r} 0 0", *(row(line) for line in (*pose[:, :3], pose[:, 3]))]
        names.append(file_of(view).relative_to(folder).as_posix())
    (folder / "list.txt").write_text("\n".join(names) + "\n")
    (folder / "bundle.out").write_text("\n".join(rows) + "\n")


def mvsnet(folder: Path, views: Sequence[View], depth_range: Sequence[float] = (0.0, 0.0)) -> None:
    """cams/NNNNNNNN_cam.txt for photos that are called by numbers."""
    place = Path(folder) / "cams"
    place.mkdir(parents=True, exist_ok=True)
    for view in views:
        if not re.fullmatch(r"\d+", view.stem, re.ASCII):
            raise InputError(f"view {view.name!r}: MVSNet's files are called by numbers, such as 00000007.png")
        rows = ["extrinsic", *(row(line) for line in view.camera.world_to_camera), "", "intrinsic",
                *(row(line) for line in view.camera.K), "", row(depth_range), ""]
        (place / f"{int(view.stem):08d}_cam.txt").write_text("\n".join(rows))


def nerfstudio(folder: Path, views: Sequence[View]) -> None:
    """transforms.json."""
    frames = []
    for view in views:
        camera = view.camera
        frames.append({"file_path": file_of(view).relative_to(folder).as_posix(), "w": camera.width, "h": camera.height,
                       "fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy,
                       "transform_matrix": (inverse_pose(camera.world_to_camera) @ FLIP).tolist()})
    text = json.dumps({"camera_model": "PINHOLE", "frames": frames}, indent=1)
    (Path(folder) / "transforms.json").write_text(text)


def neus(folder: Path, views: Sequence[View], scale_mat: np.ndarray | None = None) -> None:
    """cameras.npz, view i as number i; `scale_mat` (4, 4) takes the unit sphere to the world."""
    arrays = dict[str, Any]()
    for number, view in enumerate(views):
        K = np.eye(4)
        K[:3, :3] = view.camera.K
        arrays[f"world_mat_{number}"] = K @ view.camera.world_to_camera
        arrays[f"scale_mat_{number}"] = np.eye(4) if scale_mat is None else scale_mat
    np.savez(Path(folder) / "cameras.npz", **arrays)


def open3d_json(path: Path, cameras: Sequence[Camera]) -> None:
    """A PinholeCameraTrajectory of Open3D, which counts pixel centres at whole numbers."""
    entries = []
    for camera in cameras:
        K = camera.K
        K[:2, 2] -= 0.5
        entries.append({"class_name": "PinholeCameraParameters", "version_major": 1, "version_minor": 0,
                        "extrinsic": camera.world_to_camera.T.ravel().tolist(),
                        "intrinsic": {"width": camera.width, "height": camera.height,
                                      "intrinsic_matrix": K.T.ravel().tolist()}})
    data = {"class_name": "PinholeCameraTrajectory", "version_major": 1, "version_minor": 0, "parameters": entries}
    path.write_text(json.dumps(data, indent=1))


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """Unit quaternion x, y, z, w of a rotation matrix."""
    r = np.asarray(rotation, np.float64)
    products = np.array([[r[0, 0] - r[1, 1] - r[2, 2], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[2, 1] - r[1, 2]],
                         [0, r[1, 1] - r[0, 0] - r[2, 2], r[1, 2] + r[2, 1], r[0, 2] - r[2, 0]],
                         [0, 0, r[2, 2] - r[0, 0] - r[1, 1], r[1, 0] - r[0, 1]], [0, 0, 0, np.trace(r)]])
    found: np.ndarray = np.linalg.eigh(np.triu(products).T)[1][:, -1]       # of the lower triangle
    return found * (1 if found[3] >= 0 else -1)


def colmap_bin(place: Path, views: Sequence[View]) -> None:
    """cameras.bin, images.bin, points3D.bin: PINHOLE a photo, no points."""
    place.mkdir(parents=True, exist_ok=True)
    cameras, images = [struct.pack("<Q", len(views))], [struct.pack("<Q", len(views))]
    for number, view in enumerate(views, start=1):
        c = view.camera
        cameras.append(struct.pack("<IiQQ4d", number, 1, c.width, c.height, c.fx, c.fy, c.cx, c.cy))
        x, y, z, w = quaternion(c.world_to_camera[:3, :3])
        images.append(struct.pack("<I7dI", number, w, x, y, z, *c.world_to_camera[:3, 3], number)
                      + view.name.encode() + b"\0" + struct.pack("<Q", 0))
    (place / "cameras.bin").write_bytes(b"".join(cameras))
    (place / "images.bin").write_bytes(b"".join(images))
    (place / "points3D.bin").write_bytes(struct.pack("<Q", 0))


def colmap_txt(place: Path, views: Sequence[View]) -> None:
    """The same as text."""
    place.mkdir(parents=True, exist_ok=True)
    cameras, images = [], []
    for number, view in enumerate(views, start=1):
        c = view.camera
        cameras.append(f"{number} PINHOLE {c.width} {c.height} {row((c.fx, c.fy, c.cx, c.cy))}\n")
        x, y, z, w = quaternion(c.world_to_camera[:3, :3])
        images.append(f"{number} {row((w, x, y, z, *c.world_to_camera[:3, 3]))} {number} {view.name}\n\n")
    for name, lines in (("cameras", cameras), ("images", images), ("points3D", [])):
        (place / f"{name}.txt").write_text("".join(lines))
