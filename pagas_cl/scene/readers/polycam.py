"""Polycam's raw data: `keyframes/images`, `cameras`, `depth`, `confidence`, and `corrected_` images and cameras.

Convention: t_00 to t_23 are the first three rows of camera-to-world, ARKit's (OpenGL) axes, metres; depth is z-depth in
millimetres, smaller than the photo and covering the same; confidence 0 is low. The corrected cameras, which Polycam
adjusted, are taken where they are there.
"""

from pathlib import Path

import numpy as np

from pagas_cl.errors import InputError
from pagas_cl.scene import untrusted
from pagas_cl.scene.camera import FLIP, intrinsics
from pagas_cl.scene.readers import photos, rgbd
from pagas_cl.scene.view import Scene

_KINDS = (("corrected_cameras", "corrected_images"), ("cameras", "images"))
EXPECTED = "cameras/*.json of Polycam with images/: export raw data (Polycam's developer mode)"
_KNOWN = ("fx", "fy", "cx", "cy", "width", "height", *(f"t_{r}{c}" for r in range(3) for c in range(4)))


def detect(folder: Path) -> tuple[Path, Path] | None:
    """The folders of Polycam's cameras and of their photos."""
    root = folder / "keyframes" if (folder / "keyframes").is_dir() else folder
    for cameras, images in _KINDS:
        first = min((root / cameras).glob("*.json"), default=None)
        if first is not None and photos.list_photos(root / images) and rgbd.holds(first, b'"t_00"'):
            return root / cameras, root / images
    return None


def read(folder: Path, place: tuple[Path, Path]) -> Scene:
    """Read the keyframes."""
    cameras, images = place
    frames = [_frame(images, path) for path in sorted(cameras.glob("*.json"))]
    return rgbd.scene_of(folder, frames, rgbd.Depth(1000.0, "millimetres, as the format says"), f"{cameras} (Polycam)")


def _frame(images: Path, path: Path) -> rgbd.Frame:
    data = untrusted.read_json(path)
    untrusted.refuse_near_misses(data, _KNOWN, str(path))
    number = {key: untrusted.number(data.get(key), f"{path}: {key}") for key in _KNOWN}
    photo = photos.first_file(images, (path.stem + suffix for suffix in untrusted.IMAGE_SUFFIXES))
    if photo is None:
        raise InputError(f"{path}: its photo {path.stem}.jpg is missing in {images}")
    size, said = photos.photo_size(photo), untrusted.size(number["width"], number["height"], str(path))
    if size != said:
        raise InputError(f"{path} says {said[0]} x {said[1]} and {photo.name} is {size[0]} x {size[1]}")
    pose = np.vstack([[[number[f"t_{r}{c}"] for c in range(4)] for r in range(3)], [0, 0, 0, 1]])
    return rgbd.Frame(photo, pose @ FLIP, intrinsics(*(number[key] for key in ("fx", "fy", "cx", "cy"))),
                      photos.first_file(images.parent / "depth", (f"{path.stem}.png",)),
                      photos.first_file(images.parent / "confidence", (f"{path.stem}.png",)))
