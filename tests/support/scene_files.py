"""Small scenes of every format: written by the library that owns the format where there is one, else by ours."""

import shutil

import numpy as np
import pytest
from support import exports_depth, exports_rgbd, oracles, scene_writers

from pagas_cl.scene.readers import camera_file, meshlab


def make_open3d(folder, views):
    """By Open3D itself."""
    o3d = pytest.importorskip("open3d")
    trajectory = o3d.camera.PinholeCameraTrajectory()
    parameters = []
    for view in views:
        p = o3d.camera.PinholeCameraParameters()
        c = view.camera
        p.intrinsic = o3d.camera.PinholeCameraIntrinsic(c.width, c.height, c.fx, c.fy, c.cx - 0.5, c.cy - 0.5)
        p.extrinsic = c.world_to_camera
        parameters.append(p)
    trajectory.parameters = parameters
    o3d.io.write_pinhole_camera_trajectory(str(folder / "trajectory.json"), trajectory)


def make_log(folder, views):
    scene_writers.open3d_log(folder / "trajectory.log", [v.camera for v in views])


def make_meshlab(folder, views):
    """By pymeshlab itself, from ours."""
    pymeshlab = pytest.importorskip("pymeshlab")
    meshlab.write_project(folder / "ours.mlp", views)
    meshes = pymeshlab.MeshSet()
    meshes.load_project(str(folder / "ours.mlp"))
    meshes.save_project(str(folder / "project.mlp"))
    (folder / "ours.mlp").unlink()


def make_colmap(folder, views, binary=True):
    """By pycolmap itself."""
    pytest.importorskip("pycolmap")
    from test_readers_colmap import write_model

    write_model(folder, [v.camera for v in views], binary=binary, photos=False)


def make_frames(write):
    """By a writer of a format with photos and depth maps of its own."""
    def make(folder, views):
        y, x = np.mgrid[:48, :64]
        photo = np.stack([4 * x, 5 * y, 127 + 80 * np.sin(x / 9)], -1).astype(np.uint8)      # a network sees it small
        frames = [exports_depth.Frame(v.camera, photo, np.full(photo.shape[:2], 2.0, "f4")) for v in views]
        shutil.rmtree(folder / "images")
        write(folder, frames)

    return make


READERS = {
    "cameras": (camera_file.write, "cameras.json", oracles.camera_file, {}),
    "colmap": (make_colmap, "sparse/0/images.bin", oracles.colmap_bin, {}),
    "colmap_txt": (lambda folder, views: make_colmap(folder, views, False), "sparse/0/images.txt", oracles.colmap_txt,
                   {}),
    "nerfstudio": (scene_writers.nerfstudio, "transforms.json", oracles.nerfstudio, {}),
    "mvsnet": (scene_writers.mvsnet, "cams/00000000_cam.txt", oracles.mvsnet, {}),
    "open3d": (make_open3d, "trajectory.json", oracles.open3d, {}),
    "open3d_log": (make_log, "trajectory.log", oracles.log, {}),
    "bundler": (scene_writers.bundler, "bundle.out", oracles.bundler, {}),
    "meshlab": (make_meshlab, "project.mlp", oracles.meshlab, {"flavour": "meshlab"}),
    "da3": (make_frames(exports_depth.da3), "exports/npz/results.npz", oracles.da3, {}),
    "vggt": (make_frames(exports_depth.vggt), "predictions.npz", oracles.vggt, {}),
    "mapanything": (make_frames(exports_depth.mapanything), "predictions/000000.npz", oracles.mapanything, {}),
    "record3d": (make_frames(exports_rgbd.record3d), "metadata", oracles.record3d, {}),
    "polycam": (make_frames(exports_rgbd.polycam), "keyframes/cameras/000000.json", oracles.polycam, {}),
    "scannet": (make_frames(exports_rgbd.scannet), "pose/0.txt", oracles.pose_txt, {}),
    "7scenes": (make_frames(exports_rgbd.seven_scenes), "frame-000000.pose.txt", oracles.pose_txt, {}),
    "tum": (make_frames(exports_rgbd.tum), "groundtruth.txt", oracles.tum, {}),
    "dvmvs": (make_frames(exports_rgbd.video_mvs), "poses.txt", oracles.poses_txt, {}),
}
