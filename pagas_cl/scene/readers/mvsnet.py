"""The MVSNet layout: <cams>/NNNNNNNN_cam.txt, as BlendedMVS, DTU and COLMAP exporters write it.

Convention: world-to-camera, OpenCV axes. The exporters copy COLMAP's intrinsics, whose pixel centres are at +0.5; the
format itself does not say. It holds no image size either: that comes from the photo. Its pair.txt is not read: context
views are chosen by geometry (scene.choice).
"""

import re
from pathlib import Path

import numpy as np

from pagas_cl.errors import InputError, log
from pagas_cl.scene import untrusted
from pagas_cl.scene.readers import photos
from pagas_cl.scene.view import Scene

CAMERA_FOLDERS = ("cams", "cams_1", "Cameras", "cameras", "Cameras/train", "cam")
EXPECTED = f"NNNNNNNN_cam.txt in {', '.join(CAMERA_FOLDERS)}"
_FILE = re.compile(r"(\d+)_cam\.txt", re.ASCII)
_SCALES = (2.0, 4.0, 8.0, 0.5, 0.25, 0.125)


def detect(folder: Path) -> Path | None:
    places = (folder / name for name in CAMERA_FOLDERS if (folder / name).is_dir())
    return next((place for place in places if any(_FILE.fullmatch(p.name) for p in place.iterdir())), None)


def read(folder: Path, place: Path, *, pixel_center: float = 0.5, intrinsics_scale: float | None = None) -> Scene:
    """Read the scene; `pixel_center`: where the intrinsics put the centre of the top-left pixel.

    `intrinsics_scale` multiplies K, for camera files made for photos of another size (MVSNet's DTU training set: 4).
    Without it intrinsics that plainly belong to another size are refused.
    """
    files = {int(match[1]): p for p in sorted(place.iterdir()) if (match := _FILE.fullmatch(p.name))}
    found = _photos_by_number(folder)
    both = sorted(set(files) & set(found))
    if not both:
        raise InputError(f"{folder}: none of the {len(found)} photos has the number of a camera file in {place}")
    alone = len(files) + len(found) - 2 * len(both)
    if alone:
        log.warning("%s: %d cameras without a photo, or photos without a camera, are left out", folder, alone)
    views = []
    for photo, path in ((found[n], files[n]) for n in both):
        pose, K = read_camera(path)
        width, height = photos.photo_size(photo)
        if intrinsics_scale is None:
            _refuse_other_size(K, width, height, path, photo)
        else:
            K = K * [[intrinsics_scale], [intrinsics_scale], [1]]
        camera = untrusted.pinhole(K, pose, width, height, photo.name, pixel_center=pixel_center)
        views.append(photos.view_of(folder, camera, photo))
    return Scene(views=views, source=f"{folder} (MVSNet)")


def _photos_by_number(folder: Path) -> dict[int, Path]:
    """Photos by the number that is their name; BlendedMVS's "_masked" copies are left out."""
    found: dict[int, Path] = {}
    for path in photos.scene_photos(folder):
        if re.fullmatch(r"\d+", path.stem, re.ASCII):
            other = found.setdefault(int(path.stem), path)
            if other is not path:
                raise InputError(f"{path.parent} has two photos with the number {int(path.stem)}: "
                                 f"{other.name} and {path.name}; keep one")
    return found


def _refuse_other_size(K: np.ndarray, width: int, height: int, path: Path, photo: Path) -> None:
    """The format has no image size: a principal point far from the middle may mean photos of another size."""
    place = np.array([K[0, 2] / width, K[1, 2] / height])
    if np.abs(place - 0.5).max() < 0.2:
        return
    for scale in _SCALES:
        if np.abs(place * scale - 0.5).max() < 0.1:
            raise InputError(f"{path}: the principal point ({K[0, 2]:g}, {K[1, 2]:g}) fits photos of "
                             f"{width / scale:g} x {height / scale:g}, but {photo.name} is {width} x {height}; pass "
                             f"intrinsics_scale={scale:g} if that is so, or 1 if it is right as it is")


def read_camera(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """World-to-camera pose (4, 4) and K (3, 3) of one NNNNNNNN_cam.txt, float64."""
    tokens = untrusted.read_text(path, 1 << 20).split()
    if not 27 <= len(tokens) <= 31 or tokens[0] != "extrinsic" or tokens[17] != "intrinsic":
        raise InputError(f"{path}: expected 'extrinsic', 16 numbers, 'intrinsic', 9 numbers and the depth range of up "
                         f"to 4, got {len(tokens)} numbers: is the file damaged?")
    pose = untrusted.floats(tokens[1:17], f"{path}: extrinsic").reshape(4, 4)
    K = untrusted.floats(tokens[18:27], f"{path}: intrinsic").reshape(3, 3)
    untrusted.floats(tokens[27:], f"{path}: depth range")
    return pose, K
