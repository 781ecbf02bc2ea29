"""Small scenes written as networks, phones and RGB-D recordings write them: cameras, photos and depth maps.

`EXPORTS` has a writer a format, `write(folder, frames)`; each leaves what its program would leave, so that the readers
can be tried without it.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from pagas_cl.scene.camera import Camera, inverse_pose
from pagas_cl.scene.depthmap import save_depth
from pagas_cl.scene.images import bilinear, photo_to
from pagas_cl.scene.placement import PATCH, Placement, stretched
from pagas_cl.scene.readers import camera_file
from pagas_cl.scene.view import View
from pagas_cl.synthetic import exports

_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
NETWORK = 4          # photos are so many times as large as what a network sees


@dataclass(frozen=True, eq=False)
class Frame:
    """One photo (H, W, 3) uint8 with its camera, z-depth (H, W) float32 and, from 1 on, the confidence in it."""

    camera: Camera
    photo: np.ndarray = field(repr=False)
    depth: np.ndarray = field(repr=False)
    confidence: np.ndarray | None = field(default=None, repr=False)

    @property
    def sure(self) -> np.ndarray:
        """The confidence, 2 where none is given."""
        return np.full(self.depth.shape, 2, np.float32) if self.confidence is None else self.confidence


def photos(folder: Path, frames: Sequence[Frame], place: str = "images", name: str = "{:06d}.png") -> list[View]:
    """Write the photos; the views that they are."""
    (folder / place).mkdir(parents=True, exist_ok=True)
    views = []
    for k, frame in enumerate(frames):
        path = folder / place / name.format(k)
        Image.fromarray(frame.photo).save(path)
        views.append(View(frame.camera, path, None, path.name))
    return views


def network_size(width: int, height: int, share: float = 1 / NETWORK) -> tuple[int, int]:
    """Sides that are multiples of 14, as near to `share` of the photo's as can be."""
    return max(1, round(width * share / PATCH)) * PATCH, max(1, round(height * share / PATCH)) * PATCH


def seen(frame: Frame, placement: Placement, size: tuple[int, int]) -> Frame:
    """What a network of image size (width, height) saw: the small photo, its camera, depth and confidence there."""
    (sx, sy), (ox, oy), camera = placement.scale, placement.offset, frame.camera
    x, y = np.meshgrid((np.arange(size[0]) + 0.5 - ox) / sx, (np.arange(size[1]) + 0.5 - oy) / sy)
    inside = (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
    rough = photo_to(frame.photo, max(1, round(camera.width * sx)), max(1, round(camera.height * sy)))
    small = np.rint(bilinear(rough, x * rough.shape[1] / camera.width, y * rough.shape[0] / camera.height))
    rows, columns = np.clip(y, 0, camera.height - 1).astype(int), np.clip(x, 0, camera.width - 1).astype(int)
    K = Camera(*size, sx * camera.fx, sy * camera.fy, sx * camera.cx + ox, sy * camera.cy + oy, camera.world_to_camera)
    return Frame(K, np.where(inside[..., None], small, 255).astype(np.uint8),
                 np.where(inside, frame.depth[rows, columns], 0).astype(np.float32),
                 np.where(inside, frame.sure[rows, columns], 1).astype(np.float32))


def _small(frames: Sequence[Frame]) -> list[Frame]:
    size = frames[0].camera.width, frames[0].camera.height
    small = network_size(*size)
    return [seen(frame, stretched(size, small), small) for frame in frames]


def _stacks(frames: Sequence[Frame]) -> dict[str, np.ndarray]:
    return {"image": np.stack([f.photo for f in frames]), "depth": np.stack([f.depth for f in frames]).round(6),
            "conf": np.stack([f.sure for f in frames]),
            "extrinsics": np.stack([f.camera.world_to_camera[:3] for f in frames]).astype(np.float32),
            "intrinsics": np.stack([f.camera.K for f in frames]).astype(np.float32)}


def da3(folder: Path, frames: Sequence[Frame]) -> None:
    """Depth Anything 3, --export-format npz: exports/npz/results.npz, the photos in images/."""
    photos(folder, frames)
    (folder / "exports" / "npz").mkdir(parents=True)
    np.savez_compressed(folder / "exports" / "npz" / "results.npz", **_stacks(_small(frames)))


def da3_npy(folder: Path, frames: Sequence[Frame]) -> None:
    """The same, mini_npy: no images."""
    photos(folder, frames)
    (folder / "exports" / "mini_npy").mkdir(parents=True)
    for name, values in _stacks(_small(frames)).items():
        if name != "image":
            np.save(folder / "exports" / "mini_npy" / f"{name}.npy", values)


def da3_colmap(folder: Path, frames: Sequence[Frame]) -> None:
    """The same, colmap: the export folder itself holds the model, bin and text; no depth but a coarse mesh's."""
    views = photos(folder, frames)
    exports.colmap_bin(folder, views)
    exports.colmap_txt(folder, views)
    for name in ("rigs.bin", "frames.bin"):
        (folder / name).write_bytes(struct.pack("<Q", 0))
    _depth_maps(folder / "depth", frames)


def vggt(folder: Path, frames: Sequence[Frame]) -> None:
    """VGGT's predictions in one .npz: photos padded to a square."""
    photos(folder, frames)
    longest = max(frames[0].camera.width, frames[0].camera.height)
    side = network_size(longest, longest)[0]
    small = [seen(f, _padded(f.camera, longest, side), (side, side)) for f in frames]
    found = _stacks(small)
    np.savez(folder / "predictions.npz", depth=found["depth"][..., None], depth_conf=found["conf"],
             extrinsic=found["extrinsics"], intrinsic=found["intrinsics"],
             images=np.moveaxis(found["image"] / np.float32(255), -1, 1).astype(np.float32))


def _padded(camera: Camera, longest: int, side: int) -> Placement:
    s = side / longest
    return Placement((s, s), (s * (longest - camera.width) / 2, s * (longest - camera.height) / 2), "padded")


def vggt_colmap(folder: Path, frames: Sequence[Frame]) -> None:
    """VGGT's demo_colmap.py: sparse/, and points.ply beside it; principal points in the middle of the photos."""
    views = photos(folder, frames)
    middle = [replace(v, camera=replace(v.camera, cx=v.camera.width / 2, cy=v.camera.height / 2)) for v in views]
    exports.colmap_bin(folder / "sparse", middle)
    _cloud(folder / "sparse" / "points.ply", frames)
    _depth_maps(folder / "depth", frames)


def mapanything(folder: Path, frames: Sequence[Frame]) -> None:
    """MapAnything's predictions, an .npz a view."""
    views = photos(folder, frames)
    (folder / "predictions").mkdir()
    for view, frame in zip(views, _small(frames)):
        np.savez(folder / "predictions" / f"{view.stem}.npz", depth_z=frame.depth[None, ..., None],
                 conf=frame.sure[None], mask=(frame.depth > 0)[None, ..., None], intrinsics=frame.camera.K[None],
                 camera_poses=inverse_pose(frame.camera.world_to_camera)[None],
                 img_no_norm=frame.photo[None] / np.float32(255))


def mapanything_colmap(folder: Path, frames: Sequence[Frame]) -> None:
    """Its COLMAP export: cameras and images/ at the network's size, the originals in photos/."""
    photos(folder, frames, "photos")
    small = _small(frames)
    exports.colmap_bin(folder / "sparse", photos(folder, small))
    _cloud(folder / "points.ply", frames)
    _depth_maps(folder / "depth", frames)


def mvsanywhere(folder: Path, frames: Sequence[Frame]) -> None:
    """MVSAnywhere's mvsa_predictions/ beside a COLMAP model."""
    views = photos(folder, frames)
    exports.colmap_bin(folder / "sparse" / "0", views)
    (folder / "mvsa_predictions").mkdir()
    for view, frame in zip(views, _small(frames)):
        np.savez(folder / "mvsa_predictions" / f"{view.stem}.npz", depth=frame.depth[None],
                 normal=np.zeros((3, *frame.depth.shape), np.float32))


def open3d(folder: Path, frames: Sequence[Frame]) -> None:
    """Open3D's reconstruction system: color/, depth/ in thousandths, trajectory.log, camera_intrinsic.json."""
    photos(folder, frames, "color")
    _png(folder, frames, "depth/{:06d}.png", 1000)
    exports.open3d_log(folder / "trajectory.log", [frame.camera for frame in frames])


def seven_scenes(folder: Path, frames: Sequence[Frame]) -> None:
    """7-Scenes with camera-intrinsics.txt, as KinectFusion's examples have it."""
    photos(folder, frames, ".", "frame-{:06d}.color.png")
    _png(folder, frames, "frame-{:06d}.depth.png", 1000, none=65535)
    for k, frame in enumerate(frames):
        (folder / f"frame-{k:06d}.pose.txt").write_text(_matrix(inverse_pose(frame.camera.world_to_camera)))
    (folder / "camera-intrinsics.txt").write_text(_matrix(frames[0].camera.K))


def tum(folder: Path, frames: Sequence[Frame]) -> None:
    """TUM RGB-D: photos and depth maps under their times, lists, groundtruth.txt."""
    times = [f"{1305031102.175304 + k / 30:.6f}" for k in range(len(frames))]
    photos(folder, frames, "rgb")
    _png(folder, frames, "depth/{:06d}.png", 5000)
    for name, kind in (("rgb", "color images"), ("depth", "depth maps")):
        lines = [f"# {kind}\n", *(f"{time} {name}/{k:06d}.png\n" for k, time in enumerate(times))]
        (folder / f"{name}.txt").write_text("".join(lines))
    rows = ["# timestamp tx ty tz qx qy qz qw\n"]
    for time, frame in zip(times, frames):
        pose = inverse_pose(frame.camera.world_to_camera)
        rows.append(f"{time} {exports.row((*pose[:3, 3], *exports.quaternion(pose[:3, :3])))}\n")
    (folder / "groundtruth.txt").write_text("".join(rows))
    K = frames[0].camera.K
    K[:2, 2] -= 0.5
    (folder / "camera-intrinsics.txt").write_text(_matrix(K))


def scannet(folder: Path, frames: Sequence[Frame]) -> None:
    """ScanNet's SensReader: color/, depth/ of a smaller camera, pose/, intrinsic/."""
    photos(folder, frames, "color", "{}.png")
    camera = frames[0].camera
    size = max(2, camera.width // 2), max(2, camera.height // 2)
    placement = stretched((camera.width, camera.height), size)
    small = [seen(frame, placement, size) for frame in frames]
    _png(folder, small, "depth/{}.png", 1000)
    for part in ("pose", "intrinsic"):
        (folder / part).mkdir()
    for k, frame in enumerate(frames):
        (folder / "pose" / f"{k}.txt").write_text(_matrix(inverse_pose(frame.camera.world_to_camera)))
    for name, K in (("color", camera.K), ("depth", small[0].camera.K)):
        whole = np.eye(4)
        whole[:3, :3] = K
        (folder / "intrinsic" / f"intrinsic_{name}.txt").write_text(_matrix(whole))


def polycam(folder: Path, frames: Sequence[Frame]) -> None:
    """Polycam's raw data."""
    views = photos(folder / "keyframes", frames)
    (folder / "keyframes" / "cameras").mkdir()
    (folder / "keyframes" / "confidence").mkdir()
    small = _small(frames)
    _png(folder / "keyframes", small, "depth/{:06d}.png", 1000)
    for view, frame in zip(views, small):
        c, pose = view.camera, inverse_pose(view.camera.world_to_camera) @ _FLIP
        data = {"fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy, "width": c.width, "height": c.height,
                "blur_score": 100.0, **{f"t_{r}{k}": pose[r, k] for r in range(3) for k in range(4)}}
        (folder / "keyframes" / "cameras" / f"{view.stem}.json").write_text(json.dumps(data))
        Image.fromarray(_levels(frame) * np.uint8(127)).save(folder / "keyframes" / "confidence" / f"{view.stem}.png")


def record3d(folder: Path, frames: Sequence[Frame]) -> None:
    """An unpacked .r3d of Record3D, its maps as LZFSE streams of stored blocks."""
    photos(folder, frames, "rgbd", "{}.png")
    small = _small(frames)
    for k, frame in enumerate(small):
        (folder / "rgbd" / f"{k}.depth").write_bytes(_lzfse(frame.depth.astype("<f4").tobytes()))
        (folder / "rgbd" / f"{k}.conf").write_bytes(_lzfse(_levels(frame).tobytes()))
    (folder / "metadata").write_text(json.dumps(_record3d(frames, small)))


def record3d_exr(folder: Path, frames: Sequence[Frame]) -> None:
    """Its EXR and RGB export."""
    photos(folder, frames, "rgb", "{}.png")
    small = _small(frames)
    (folder / "depth").mkdir()
    for k, frame in enumerate(small):
        write_exr(folder / "depth" / f"{k}.exr", frame.depth)
    (folder / "metadata.json").write_text(json.dumps(_record3d(frames, small)))


def _record3d(frames: Sequence[Frame], small: Sequence[Frame]) -> dict[str, Any]:
    c, poses = frames[0].camera, [inverse_pose(f.camera.world_to_camera) @ _FLIP for f in frames]
    return {"w": c.width, "h": c.height, "dw": small[0].depth.shape[1], "dh": small[0].depth.shape[0], "fps": 60,
            "K": c.K.T.ravel().tolist(),
            "poses": [[*map(float, exports.quaternion(pose[:3, :3])), *map(float, pose[:3, 3])] for pose in poses],
            "perFrameIntrinsicCoeffs": [[f.camera.fx, f.camera.fy, f.camera.cx, f.camera.cy] for f in frames]}


def nerfstudio(folder: Path, frames: Sequence[Frame]) -> None:
    """nerfstudio's transforms.json with depth_file_path."""
    exports.nerfstudio(folder, photos(folder, frames))
    _png(folder, frames, "depth/{:06d}.png", 1000)
    data = json.loads((folder / "transforms.json").read_text())
    for k, frame in enumerate(data["frames"]):
        frame["depth_file_path"] = f"depth/{k:06d}.png"
    (folder / "transforms.json").write_text(json.dumps(data, indent=1))


def video_mvs(folder: Path, frames: Sequence[Frame]) -> None:
    """K.txt, poses.txt, images/, depth/, as DeepVideoMVS has them."""
    photos(folder, frames)
    _png(folder, frames, "depth/{:06d}.png", 1000)
    K = frames[0].camera.K
    K[:2, 2] -= 0.5
    (folder / "K.txt").write_text(_matrix(K))
    (folder / "poses.txt").write_text("".join(
        exports.row(inverse_pose(f.camera.world_to_camera).ravel()) + "\n" for f in frames))


def _with_depth_maps(write: Callable[[Path, list[View]], Any], place: str = "images") -> Callable[..., None]:
    """A format without depth: its cameras, and depth maps of ours beside it."""

    def written(folder: Path, frames: Sequence[Frame]) -> None:
        write(folder, photos(folder, frames, place))
        _depth_maps(folder / "depth", frames)

    return written


def _centred(folder: Path, views: list[View]) -> None:
    """Bundler's format holds one focal length and no principal point: the cameras lose theirs."""
    exports.bundler(folder, [replace(v, camera=replace(v.camera, cx=v.camera.width / 2, cy=v.camera.height / 2,
                                                       fy=v.camera.fx)) for v in views])


def _sparse(folder: Path, views: list[View]) -> None:
    exports.colmap_bin(folder / "sparse" / "0", views)


def _meshlab(folder: Path, views: list[View]) -> None:
    from pagas_cl.scene.readers.meshlab import write_project

    write_project(folder / "project.mlp", views)


def _depth_maps(folder: Path, frames: Sequence[Frame]) -> None:
    for k, frame in enumerate(frames):
        save_depth(folder / f"{k:06d}.npz", frame.depth)


def _cloud(path: Path, frames: Sequence[Frame]) -> None:
    """A point cloud of the first view's depth, .ply."""
    camera, depth = frames[0].camera, frames[0].depth[::8, ::8]
    rays = camera.rays()[::8, ::8] * depth[..., None]
    points = (rays[depth > 0] - camera.world_to_camera[:3, 3]) @ camera.world_to_camera[:3, :3]
    head = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz")
    path.write_text(f"{head}end_header\n{_matrix(points)}")


def _png(folder: Path, frames: Sequence[Frame], name: str, scale: float, none: int = 0) -> None:
    for k, frame in enumerate(frames):
        path = folder / name.format(k)
        path.parent.mkdir(parents=True, exist_ok=True)
        values = np.where(frame.depth > 0, np.rint(frame.depth * scale).clip(0, 65534), none)
        Image.fromarray(values.astype(np.uint16)).save(path)


def _levels(frame: Frame) -> np.ndarray:
    """Confidence as phones have it: 0, 1, 2."""
    return np.where(frame.sure < 1.25, 0, np.where(frame.sure < 1.5, 1, 2)).astype(np.uint8)


def _matrix(values: np.ndarray) -> str:
    return "".join(exports.row(line) + "\n" for line in values)


def _lzfse(data: bytes) -> bytes:
    return b"bvx-" + struct.pack("<I", len(data)) + data + b"bvx$"


def write_exr(path: Path, values: np.ndarray) -> None:
    """One channel R, 32 bit, ZIP."""
    height, width = values.shape
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    attributes = (("channels", "chlist", b"R\0" + struct.pack("<iIii", 2, 0, 1, 1) + b"\0"),
                  ("compression", "compression", b"\3"), ("dataWindow", "box2i", window),
                  ("displayWindow", "box2i", window), ("lineOrder", "lineOrder", b"\0"),
                  ("pixelAspectRatio", "float", struct.pack("<f", 1)),
                  ("screenWindowCenter", "v2f", struct.pack("<2f", 0, 0)),
                  ("screenWindowWidth", "float", struct.pack("<f", 1)))
    head = struct.pack("<II", 20000630, 2) + b"".join(
        f"{name}\0{kind}\0".encode() + struct.pack("<i", len(data)) + data for name, kind, data in attributes) + b"\0"
    blocks, place = [], len(head) + 8 * -(-height // 16)
    for top in range(0, height, 16):
        raw = np.frombuffer(values[top:top + 16].astype("<f4").tobytes(), np.uint8)
        split = np.concatenate([raw[::2], raw[1::2]]).astype(np.int64)
        differences = np.concatenate([split[:1], np.diff(split) + 128]).astype(np.uint8)
        packed = zlib.compress(differences.tobytes())
        packed = packed if len(packed) < len(raw) else raw.tobytes()
        blocks.append(struct.pack("<ii", top, len(packed)) + packed)
    offsets = np.cumsum([place, *(len(block) for block in blocks)])[:-1]
    path.write_bytes(head + offsets.astype("<u8").tobytes() + b"".join(blocks))


EXPORTS: dict[str, Callable[[Path, Sequence[Frame]], None]] = {
    "cameras": _with_depth_maps(camera_file.write), "colmap": _with_depth_maps(_sparse), "nerfstudio": nerfstudio,
    "mvsnet": _with_depth_maps(exports.mvsnet), "neus": _with_depth_maps(exports.neus, "image"), "open3d": open3d,
    "bundler": _with_depth_maps(_centred), "meshlab": _with_depth_maps(_meshlab), "da3": da3, "da3-npy": da3_npy,
    "da3-colmap": da3_colmap, "vggt": vggt, "vggt-colmap": vggt_colmap, "mapanything": mapanything,
    "mapanything-colmap": mapanything_colmap, "mvsanywhere": mvsanywhere, "record3d": record3d,
    "record3d-exr": record3d_exr, "polycam": polycam, "scannet": scannet, "7scenes": seven_scenes, "tum": tum,
    "dvmvs": video_mvs,
}
