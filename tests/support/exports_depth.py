"""Small scenes written as networks write them; and `EXPORTS`, a writer of every format, `write(folder, frames)`: each
leaves what its program would leave, so that the readers can be tried without it."""

import struct
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from support import exports
from support.exports_rgbd import RGBD
from support.frames import Frame, depth_maps, matrix, network_size, photos, seen, small_of

from pagas_cl.scene.camera import inverse_pose
from pagas_cl.scene.depth.placement import Placement
from pagas_cl.scene.readers import camera_file
from pagas_cl.scene.readers.meshlab import write_project
from pagas_cl.scene.view import View


def _stacks(frames: Sequence[Frame]) -> dict[str, np.ndarray]:
    return {"image": np.stack([f.photo for f in frames]), "depth": np.stack([f.depth for f in frames]).round(6),
            "conf": np.stack([f.sure for f in frames]),
            "extrinsics": np.stack([f.camera.world_to_camera[:3] for f in frames]).astype(np.float32),
            "intrinsics": np.stack([f.camera.K for f in frames]).astype(np.float32)}


def da3(folder: Path, frames: Sequence[Frame]) -> None:
    """Depth Anything 3, --export-format npz: exports/npz/results.npz, the photos in images/."""
    photos(folder, frames)
    (folder / "exports" / "npz").mkdir(parents=True)
    np.savez_compressed(folder / "exports" / "npz" / "results.npz", **_stacks(small_of(frames)))


def da3_npy(folder: Path, frames: Sequence[Frame]) -> None:
    """The same, mini_npy: no images."""
    photos(folder, frames)
    (folder / "exports" / "mini_npy").mkdir(parents=True)
    for name, values in _stacks(small_of(frames)).items():
        if name != "image":
            np.save(folder / "exports" / "mini_npy" / f"{name}.npy", values)


def da3_colmap(folder: Path, frames: Sequence[Frame]) -> None:
    """The same, colmap: the export folder itself holds the model, bin and text; no depth but a coarse mesh's."""
    views = photos(folder, frames)
    exports.colmap_bin(folder, views)
    exports.colmap_txt(folder, views)
    for name in ("rigs.bin", "frames.bin"):
        (folder / name).write_bytes(struct.pack("<Q", 0))
    depth_maps(folder / "depth", frames)


def vggt(folder: Path, frames: Sequence[Frame]) -> None:
    """VGGT's predictions in one .npz: photos padded to a square."""
    photos(folder, frames)
    longest = max(frames[0].camera.width, frames[0].camera.height)
    side = network_size(longest, longest)[0]
    s = side / longest
    small = [seen(f, Placement((s, s), (s * (longest - f.camera.width) / 2, s * (longest - f.camera.height) / 2),
                               "padded"), (side, side)) for f in frames]
    found = _stacks(small)
    np.savez(folder / "predictions.npz", depth=found["depth"][..., None], depth_conf=found["conf"],
             extrinsic=found["extrinsics"], intrinsic=found["intrinsics"],
             images=np.moveaxis(found["image"] / np.float32(255), -1, 1).astype(np.float32))


def vggt_colmap(folder: Path, frames: Sequence[Frame]) -> None:
    """VGGT's demo_colmap.py: sparse/, and points.ply next to it; principal points in the middle of the photos."""
    views = photos(folder, frames)
    middle = [replace(v, camera=replace(v.camera, cx=v.camera.width / 2, cy=v.camera.height / 2)) for v in views]
    exports.colmap_bin(folder / "sparse", middle)
    _cloud(folder / "sparse" / "points.ply", frames)
    depth_maps(folder / "depth", frames)


def mapanything(folder: Path, frames: Sequence[Frame]) -> None:
    """MapAnything's predictions, an .npz a view."""
    views = photos(folder, frames)
    (folder / "predictions").mkdir()
    for view, frame in zip(views, small_of(frames)):
        np.savez(folder / "predictions" / f"{view.stem}.npz", depth_z=frame.depth[None, ..., None],
                 conf=frame.sure[None], mask=(frame.depth > 0)[None, ..., None], intrinsics=frame.camera.K[None],
                 camera_poses=inverse_pose(frame.camera.world_to_camera)[None],
                 img_no_norm=frame.photo[None] / np.float32(255))


def mapanything_colmap(folder: Path, frames: Sequence[Frame]) -> None:
    """Its COLMAP export: cameras and images/ at the network's size, the originals in photos/."""
    photos(folder, frames, "photos")
    small = small_of(frames)
    exports.colmap_bin(folder / "sparse", photos(folder, small))
    _cloud(folder / "points.ply", frames)
    depth_maps(folder / "depth", frames)


def mvsanywhere(folder: Path, frames: Sequence[Frame]) -> None:
    """MVSAnywhere's mvsa_predictions/ next to a COLMAP model."""
    views = photos(folder, frames)
    exports.colmap_bin(folder / "sparse" / "0", views)
    (folder / "mvsa_predictions").mkdir()
    for view, frame in zip(views, small_of(frames)):
        np.savez(folder / "mvsa_predictions" / f"{view.stem}.npz", depth=frame.depth[None],
                 normal=np.zeros((3, *frame.depth.shape), np.float32))


def _with_depth_maps(write: Callable[[Path, list[View]], Any], place: str = "images") -> Callable[..., None]:
    """A format without depth: its cameras, and depth maps as pagas_cl writes them next to it."""

    def written(folder: Path, frames: Sequence[Frame]) -> None:
        write(folder, photos(folder, frames, place))
        depth_maps(folder / "depth", frames)

    return written


def _centred(folder: Path, views: list[View]) -> None:
    """Bundler's format holds one focal length and no principal point: the cameras lose theirs."""
    exports.bundler(folder, [replace(v, camera=replace(v.camera, cx=v.camera.width / 2, cy=v.camera.height / 2,
                                                       fy=v.camera.fx)) for v in views])


def _cloud(path: Path, frames: Sequence[Frame]) -> None:
    """A point cloud of the first view's depth, .ply."""
    camera, depth = frames[0].camera, frames[0].depth[::8, ::8]
    rays = camera.rays()[::8, ::8] * depth[..., None]
    points = (rays[depth > 0] - camera.world_to_camera[:3, 3]) @ camera.world_to_camera[:3, :3]
    head = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz")
    path.write_text(f"{head}end_header\n{matrix(points)}")


EXPORTS: dict[str, Callable[[Path, Sequence[Frame]], None]] = {
    "cameras": _with_depth_maps(camera_file.write),
    "colmap": _with_depth_maps(lambda folder, views: exports.colmap_bin(folder / "sparse" / "0", views)),
    "mvsnet": _with_depth_maps(exports.mvsnet), "neus": _with_depth_maps(exports.neus, "image"),
    "bundler": _with_depth_maps(_centred), "da3": da3, "da3-npy": da3_npy,
    "meshlab": _with_depth_maps(lambda folder, views: write_project(folder / "project.mlp", views)),
    "da3-colmap": da3_colmap, "vggt": vggt, "vggt-colmap": vggt_colmap, "mapanything": mapanything,
    "mapanything-colmap": mapanything_colmap, "mvsanywhere": mvsanywhere, **RGBD,
}
