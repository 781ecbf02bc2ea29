"""Polycam's raw data: `keyframes/images`, `cameras`, `depth`, `confidence`, and `corrected_` images and cameras.

Convention: t_00 to t_23 are the first three rows of camera-to-world, ARKit's (OpenGL) axes, metres; depth is z-depth in
millimetres, smaller than the photo and covering the same; confidence 0 is low. The corrected cameras, which Polycam
adjusted, are taken where they are there.
"""

from pathlib import Path

import numpy as np

from pagas_cl.errors import InputError
from pagas_cl.scene.camera import FLIP, intrinsics
from pagas_cl.scene.readers import photos, rgbd, untrusted
from pagas_cl.scene.view import Scene

_KINDS = (("corrected_cameras", "corrected_images"), ("cameras", "images"))
_KNOWN = ("fx", "fy", "cx", "cy", "width", "height", *(f"t_{r}{c}" for r in range(3) for c in range(4)))


def _root(folder: Path) -> Path:
    return folder / "keyframes" if (folder / "keyframes").is_dir() else folder


def detect(folder: Path) -> bool:
    """Whether there are keyframes with cameras of Polycam."""
    root = _root(folder)
    path = next((file for cameras, _ in _KINDS for file in sorted((root / cameras).glob("*.json"))), None)
    try:
        return path is not None and b'"t_00"' in path.read_bytes()[:1 << 16]
    except OSError:
        return False


def read(folder: Path) -> Scene:
    """Read the keyframes."""
    root = _root(folder)
    places = ((root / cameras, root / images) for cameras, images in _KINDS)
    place = next((both for both in places if next(both[0].glob("*.json"), None) is not None
                  and photos.list_photos(both[1])), None)
    if place is None:
        raise InputError(f"{root} has no cameras/*.json with images/: export raw data (Polycam's developer mode)")
    frames = [_frame(root, place[1], path) for path in sorted(place[0].glob("*.json"))]
    return rgbd.scene_of(folder, frames, rgbd.Depth(1000.0, "millimetres, as the format says"),
                         f"{place[0]} (Polycam)")


def _frame(root: Path, images: Path, path: Path) -> rgbd.Frame:
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
                      photos.first_file(root / "depth", (f"{path.stem}.png",)),
                      photos.first_file(root / "confidence", (f"{path.stem}.png",)))
