"""Sequences of multi-view stereo networks (DeepVideoMVS and its followers): `K.txt`, `poses.txt`, `images/`, `depth/`.

Convention: a line of poses.txt is a 4 x 4 matrix, camera-to-world, metres, OpenCV; line k belongs to the k-th photo by
name; K counts pixel centres at whole numbers; depth/<name>.png is registered, in millimetres.
"""

from pathlib import Path

import numpy as np

from pagas_cl.errors import InputError, log
from pagas_cl.scene import untrusted
from pagas_cl.scene.readers import photos, rgbd
from pagas_cl.scene.view import Scene

EXPECTED = "poses.txt with K.txt and images/"


def detect(folder: Path) -> Path | None:
    """The poses.txt, where K.txt and images/ are there too."""
    there = (folder / "K.txt").is_file() and (folder / "poses.txt").is_file() and (folder / "images").is_dir()
    return folder / "poses.txt" if there else None


def read(folder: Path, path: Path) -> Scene:
    """Read the frames; poses beyond the photos (of a sequence that was cut) are left out and counted."""
    images = photos.list_photos(folder / "images")
    lines = [line.split() for line in untrusted.read_text(path).splitlines() if line.strip()]
    if not images or len(lines) < len(images):
        raise InputError(f"{path} has {len(lines)} poses and {folder / 'images'} has {len(images)} photos, expected a "
                         "pose a photo")
    if len(lines) > len(images):
        log.info("%s: %d poses after the last of the %d photos are left out", path, len(lines) - len(images),
                 len(images))
    K = rgbd.K_of(folder / "K.txt")
    frames = []
    for k, (photo, row) in enumerate(zip(images, lines)):
        pose = np.asarray(untrusted.floats(row, f"{path}, line {k + 1}", 16)).reshape(4, 4)
        depth = photos.first_file(folder / "depth", (f"{photo.stem}.png",))
        frames.append(rgbd.Frame(photo, pose, K, depth, pixel_center=0.0))
    return rgbd.scene_of(folder, frames, rgbd.Depth(1000.0, "millimetres, as the format says"),
                         f"{path} (DeepVideoMVS)")
