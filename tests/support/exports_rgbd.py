"""Small scenes written as phones and RGB-D recordings write them: cameras, photos and depth maps."""

import json
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from support import exports
from support.frames import Frame, matrix, photos, png, seen, small_of

from pagas_cl.errors import need
from pagas_cl.scene.camera import FLIP, inverse_pose
from pagas_cl.scene.depth.placement import stretched
from pagas_cl.scene.readers.meshlab import row


def open3d(folder: Path, frames: Sequence[Frame]) -> None:
    """Frames as Open3D's tutorials have them: color/, depth/ in thousandths, trajectory.json."""
    photos(folder, frames, "color")
    png(folder, frames, "depth/{:06d}.png", 1000)
    exports.open3d_json(folder / "trajectory.json", [frame.camera for frame in frames])


def seven_scenes(folder: Path, frames: Sequence[Frame]) -> None:
    """7-Scenes with camera-intrinsics.txt, as KinectFusion's examples have it."""
    photos(folder, frames, ".", "frame-{:06d}.color.png")
    png(folder, frames, "frame-{:06d}.depth.png", 1000, none=65535)
    for k, frame in enumerate(frames):
        (folder / f"frame-{k:06d}.pose.txt").write_text(matrix(inverse_pose(frame.camera.world_to_camera)))
    (folder / "camera-intrinsics.txt").write_text(matrix(frames[0].camera.K))


def tum(folder: Path, frames: Sequence[Frame]) -> None:
    """TUM RGB-D: photos and depth maps under their times, lists, groundtruth.txt."""
    times = [f"{1305031102.175304 + k / 30:.6f}" for k in range(len(frames))]
    photos(folder, frames, "rgb")
    png(folder, frames, "depth/{:06d}.png", 5000)
    for name, kind in (("rgb", "color images"), ("depth", "depth maps")):
        lines = [f"# {kind}\n", *(f"{time} {name}/{k:06d}.png\n" for k, time in enumerate(times))]
        (folder / f"{name}.txt").write_text("".join(lines))
    rows = ["# timestamp tx ty tz qx qy qz qw\n"]
    for time, frame in zip(times, frames):
        pose = inverse_pose(frame.camera.world_to_camera)
        rows.append(f"{time} {row((*pose[:3, 3], *exports.quaternion(pose[:3, :3])))}\n")
    (folder / "groundtruth.txt").write_text("".join(rows))
    K = frames[0].camera.K
    K[:2, 2] -= 0.5
    (folder / "camera-intrinsics.txt").write_text(matrix(K))


def scannet(folder: Path, frames: Sequence[Frame]) -> None:
    """ScanNet's SensReader: color/, depth/ of a smaller camera, pose/, intrinsic/."""
    photos(folder, frames, "color", "{}.png")
    camera = frames[0].camera
    size = max(2, camera.width // 2), max(2, camera.height // 2)
    placement = stretched((camera.width, camera.height), size)
    small = [seen(frame, placement, size) for frame in frames]
    png(folder, small, "depth/{}.png", 1000)
    for part in ("pose", "intrinsic"):
        (folder / part).mkdir()
    for k, frame in enumerate(frames):
        (folder / "pose" / f"{k}.txt").write_text(matrix(inverse_pose(frame.camera.world_to_camera)))
    for name, K in (("color", camera.K), ("depth", small[0].camera.K)):
        whole = np.eye(4)
        whole[:3, :3] = K
        (folder / "intrinsic" / f"intrinsic_{name}.txt").write_text(matrix(whole))


def polycam(folder: Path, frames: Sequence[Frame]) -> None:
    """Polycam's raw data."""
    views = photos(folder / "keyframes", frames)
    (folder / "keyframes" / "cameras").mkdir()
    (folder / "keyframes" / "confidence").mkdir()
    small = small_of(frames)
    png(folder / "keyframes", small, "depth/{:06d}.png", 1000)
    for view, frame in zip(views, small):
        c, pose = view.camera, inverse_pose(view.camera.world_to_camera) @ FLIP
        data = {"fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy, "width": c.width, "height": c.height,
                "blur_score": 100.0, **{f"t_{r}{k}": pose[r, k] for r in range(3) for k in range(4)}}
        (folder / "keyframes" / "cameras" / f"{view.stem}.json").write_text(json.dumps(data))
        Image.fromarray(_levels(frame) * np.uint8(127)).save(folder / "keyframes" / "confidence" / f"{view.stem}.png")


def record3d(folder: Path, frames: Sequence[Frame]) -> None:
    """An unpacked .r3d of Record3D, its maps as LZFSE streams of stored blocks."""
    photos(folder, frames, "rgbd", "{}.png")
    small = small_of(frames)
    for k, frame in enumerate(small):
        (folder / "rgbd" / f"{k}.depth").write_bytes(_lzfse(frame.depth.astype("<f4").tobytes()))
        (folder / "rgbd" / f"{k}.conf").write_bytes(_lzfse(_levels(frame).tobytes()))
    (folder / "metadata").write_text(json.dumps(_record3d(frames, small)))


def record3d_exr(folder: Path, frames: Sequence[Frame]) -> None:
    """Its EXR and RGB export."""
    photos(folder, frames, "rgb", "{}.png")
    small = small_of(frames)
    (folder / "depth").mkdir()
    for k, frame in enumerate(small):
        write_exr(folder / "depth" / f"{k}.exr", frame.depth)
    (folder / "metadata.json").write_text(json.dumps(_record3d(frames, small)))


def _record3d(frames: Sequence[Frame], small: Sequence[Frame]) -> dict[str, Any]:
    c, poses = frames[0].camera, [inverse_pose(f.camera.world_to_camera) @ FLIP for f in frames]
    return {"w": c.width, "h": c.height, "dw": small[0].depth.shape[1], "dh": small[0].depth.shape[0], "fps": 60,
            "K": c.K.T.ravel().tolist(),
            "poses": [[*map(float, exports.quaternion(pose[:3, :3])), *map(float, pose[:3, 3])] for pose in poses],
            "perFrameIntrinsicCoeffs": [[f.camera.fx, f.camera.fy, f.camera.cx, f.camera.cy] for f in frames]}


def nerfstudio(folder: Path, frames: Sequence[Frame]) -> None:
    """nerfstudio's transforms.json with depth_file_path."""
    exports.nerfstudio(folder, photos(folder, frames))
    png(folder, frames, "depth/{:06d}.png", 1000)
    data = json.loads((folder / "transforms.json").read_text())
    for k, frame in enumerate(data["frames"]):
        frame["depth_file_path"] = f"depth/{k:06d}.png"
    (folder / "transforms.json").write_text(json.dumps(data, indent=1))


def video_mvs(folder: Path, frames: Sequence[Frame]) -> None:
    """K.txt, poses.txt, images/, depth/, as DeepVideoMVS has them."""
    photos(folder, frames)
    png(folder, frames, "depth/{:06d}.png", 1000)
    K = frames[0].camera.K
    K[:2, 2] -= 0.5
    (folder / "K.txt").write_text(matrix(K))
    (folder / "poses.txt").write_text("".join(
        row(inverse_pose(f.camera.world_to_camera).ravel()) + "\n" for f in frames))


def _levels(frame: Frame) -> np.ndarray:
    """Confidence as phones have it: 0, 1, 2."""
    return np.where(frame.sure < 1.25, 0, np.where(frame.sure < 1.5, 1, 2)).astype(np.uint8)


def _lzfse(data: bytes) -> bytes:
    return b"bvx-" + struct.pack("<I", len(data)) + data + b"bvx$"


def write_exr(path: Path, values: np.ndarray) -> None:
    """One channel R, 32 bit, ZIP."""
    library = need("OpenEXR", "exr", f"writing {path.name}")
    header = {"compression": library.ZIP_COMPRESSION, "type": library.scanlineimage}
    with library.File(header, {"R": np.ascontiguousarray(values, np.float32)}) as file:
        file.write(str(path))


RGBD: dict[str, Callable[[Path, Sequence[Frame]], None]] = {
    "open3d": open3d, "nerfstudio": nerfstudio, "record3d": record3d, "record3d-exr": record3d_exr, "polycam": polycam,
    "scannet": scannet, "7scenes": seven_scenes, "tum": tum, "dvmvs": video_mvs,
}
