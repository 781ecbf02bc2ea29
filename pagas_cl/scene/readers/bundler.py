"""Bundler's bundle.out with its list of photos.

Convention: world-to-camera with OpenGL axes (x right, y up, looking along -z), one focal length, no principal point:
it is the photo's middle. Sizes come from the photos. What the format cannot hold (off-centre principal points,
non-square pixels) is lost by whoever writes it.
"""

from os.path import isfile
from pathlib import Path

import numpy as np

from pagas_cl.errors import InputError, log, short
from pagas_cl.scene import untrusted
from pagas_cl.scene.camera import FLIP, intrinsics
from pagas_cl.scene.readers import photos
from pagas_cl.scene.view import Scene

EXPECTED = "bundle.out of Bundler"
FILES = ("bundle.out", "bundle.rd.out", "bundle/bundle.out")
LISTS = ("list.txt", "bundle.out.list.txt", "bundle.rd.out.list.txt", "bundle/list.txt")


def detect(folder: Path) -> Path | None:
    return photos.first_file(folder, FILES)


def read(folder: Path, path: Path, *, outside: bool = False) -> Scene:
    """Read the scene without the cameras that Bundler did not place; `outside`: also photos outside `folder`."""
    cameras = _cameras(path)
    images = _images(folder, path, len(cameras), outside)
    placed = [(camera, photo) for camera, photo in zip(cameras, images) if camera[0] != 0]
    names, views = photos.names_of([photo for _, photo in placed]), []
    for ((f, R, t), photo), name in zip(placed, names):
        width, height = photos.photo_size(photo)
        pose = FLIP[:3, :3] @ np.column_stack([R, t])
        camera = untrusted.pinhole(intrinsics(f, f, width / 2, height / 2), pose, width, height, name)
        views.append(photos.view_of(folder, camera, photo, name=name))
    if not views:
        raise InputError(f"{path}: none of the {len(cameras)} cameras was placed by Bundler (focal length 0)")
    if len(views) < len(cameras):
        log.info("%s: %d of %d cameras were not placed and are left out", path, len(cameras) - len(views), len(cameras))
    return Scene(views=views, source=f"{path} (Bundler)")


def _images(folder: Path, path: Path, count: int, outside: bool) -> list[Path]:
    names = photos.first_file(folder, LISTS)
    if names is None:
        log.warning("%s names no photos: they are taken in the order of their names, without a %s", path, LISTS[0])
        return photos.one_photo_each(photos.scene_photos(folder), count, str(path))
    lines = [line if line.lower().endswith(untrusted.IMAGE_SUFFIXES) else line.rsplit(maxsplit=2)[0]     # 0 and focal
             for line in map(str.strip, untrusted.read_text(names).splitlines()) if line]
    if len(lines) != count:
        raise InputError(f"{names} names {len(lines)} photos and {path} has {count} cameras, expected as many")
    return [_photo(folder, line, str(names), outside) for line in lines]


def _photo(folder: Path, name: str, where: str, outside: bool) -> Path:
    path = untrusted.inside(folder, name, f"{where}: photo", outside=outside)
    in_folder = photos.first_file(folder, (f"{place}/{path.name}" for place in photos.FOLDERS))
    return in_folder if in_folder and not isfile(path) else photos.existing(path, where)


def _cameras(path: Path) -> list[tuple[float, np.ndarray, np.ndarray]]:
    """[(f, R (3, 3), t (3,))] in Bundler's axes, float64."""
    lines = untrusted.read_text(path).splitlines()
    if not lines or not lines[0].startswith("# Bundle file v0.3"):
        raise InputError(f"{path} starts with {short(lines[0] if lines else '')}, expected '# Bundle file v0.3'")
    rows = [line.split() for line in lines[1:] if line.strip() and not line.startswith("#")]
    if not rows or len(rows[0]) != 2:
        raise InputError(f"{path}: the second line holds no two counts: is the file damaged?")
    cameras, points = (untrusted.whole(untrusted.float_of(n, f"{path}: count"), 0, 10**8, f"{path}: count")
                       for n in rows[0])
    if rows[-1] == ["0"] * 3 and len(rows) == 2 + 5 * cameras + 3 * points:
        rows.pop()      # MeshLab's last line
    if len(rows) != 1 + 5 * cameras + 3 * points:
        raise InputError(f"{path} has {len(rows)} lines, expected {1 + 5 * cameras + 3 * points} for {cameras} cameras "
                         f"and {points} points: is the file cut off?")
    return [_camera(rows[1 + 5 * i:6 + 5 * i], f"{path}, camera {i}") for i in range(cameras)]


def _camera(rows: list[list[str]], where: str) -> tuple[float, np.ndarray, np.ndarray]:
    f, k1, k2 = untrusted.floats(rows[0], f"{where}: focal length and distortion", 3)
    if f != 0 and (k1 != 0 or k2 != 0):
        raise InputError(f"{where}: distortion is {k1:g} {k2:g}, expected 0 0: photos must be undistorted first "
                         "(Bundler's RadialUndistort, then bundle.rd.out)")
    R = np.array([untrusted.floats(row, f"{where}: rotation", 3) for row in rows[1:4]])
    return f, R, untrusted.floats(rows[4], f"{where}: translation", 3)
