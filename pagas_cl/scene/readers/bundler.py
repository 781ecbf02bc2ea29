"""Bundler's bundle.out with its list of photos.

Convention: world-to-camera with OpenGL axes (x right, y up, looking along -z), one focal length, no principal point:
it is the photo's middle. Sizes come from the photos. What the format cannot hold (off-centre principal points,
non-square pixels) is lost by whoever writes it; `write` refuses such cameras.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pagas_cl.errors import InputError
from pagas_cl.scene.readers import photos, untrusted
from pagas_cl.scene.view import Scene, View

FILES = ("bundle.out", "bundle.rd.out", "bundle/bundle.out")
LISTS = ("list.txt", "bundle.out.list.txt", "bundle.rd.out.list.txt", "bundle/list.txt")
_FLIP = np.diag([1.0, -1.0, -1.0])
log = logging.getLogger("pagas_cl")


def detect(folder: Path) -> bool:
    """Whether `folder` holds a bundle.out."""
    return any((Path(folder) / name).is_file() for name in FILES)


def read(folder: Path, *, outside: bool = False) -> Scene:
    """Read the scene; cameras with focal length 0, which Bundler did not place, are left out (and counted).

    `outside`: whether photos outside `folder` may be read.
    """
    folder = Path(folder)
    path = next((folder / name for name in FILES if (folder / name).is_file()), folder / FILES[0])
    cameras, points = read_bundle(path)
    images = _images(folder, path, len(cameras), outside)
    views = []
    for (f, R, t), photo in zip(cameras, images):
        if f == 0:
            continue
        width, height = photos.photo_size(photo)
        K = np.array([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1]])
        camera = untrusted.pinhole(K, np.column_stack([_FLIP @ R, _FLIP @ t]), width, height, photo.name)
        views.append(photos.view_of(folder, camera, photo))
    if not views:
        raise InputError(f"{path}: none of the {len(cameras)} cameras was placed by Bundler (focal length 0)")
    if len(views) < len(cameras):
        log.info("%s: %d of %d cameras were not placed and are left out", path, len(cameras) - len(views), len(cameras))
    return Scene(views=views, source=f"{path} (Bundler)", points=points)


def _images(folder: Path, path: Path, count: int, outside: bool) -> list[Path]:
    names = next((folder / name for name in LISTS if (folder / name).is_file()), None)
    if names is None:
        return photos.one_photo_each(photos.scene_photos(folder), count, str(path))
    lines = [line.split()[0] for line in untrusted.read_text(names).splitlines() if line.strip()]
    if len(lines) != count:
        raise InputError(f"{names} names {len(lines)} photos and {path} has {count} cameras, expected as many")
    return [_photo(folder, names, line, outside) for line in lines]


def _photo(folder: Path, names: Path, line: str, outside: bool) -> Path:
    path = photos.inside(folder, line, f"{names}: photo", outside=outside)
    for candidate in [path] + [folder / place / path.name for place in photos.FOLDERS]:
        if candidate.is_file():
            return candidate
    return photos.existing(path, str(names))


def read_bundle(path: Path) -> tuple[list[tuple[float, np.ndarray, np.ndarray]], np.ndarray]:
    """[(f, R (3, 3), t (3,))] in Bundler's axes, and points (N, 3), float64."""
    lines = untrusted.read_text(Path(path)).splitlines()
    if not lines or not lines[0].startswith("# Bundle file v0.3"):
        raise InputError(f"{path} starts with {untrusted.short(lines[0] if lines else '')}, expected "
                         "'# Bundle file v0.3'")
    rows = [line.split() for line in lines[1:] if line.strip() and not line.startswith("#")]
    if not rows or len(rows[0]) != 2:
        raise InputError(f"{path}: the second line holds no two counts: is the file damaged?")
    cameras, points = (untrusted.whole(untrusted.word(n, f"{path}: count"), 0, 10**8, f"{path}: count")
                       for n in rows[0])
    if len(rows) != 1 + 5 * cameras + 3 * points:
        raise InputError(f"{path} has {len(rows)} lines, expected {1 + 5 * cameras + 3 * points} for {cameras} cameras "
                         f"and {points} points: is the file cut off?")
    found = [_camera(rows[1 + 5 * i:6 + 5 * i], f"{path}, camera {i}") for i in range(cameras)]
    first = 1 + 5 * cameras
    places = [_three(rows[first + 3 * i], f"{path}, point {i}") for i in range(points)]
    return found, np.array(places, np.float64).reshape(-1, 3)


def _camera(rows: Sequence[Sequence[str]], where: str) -> tuple[float, np.ndarray, np.ndarray]:
    f, k1, k2 = _three(rows[0], f"{where}: focal length and distortion")
    if f != 0 and (k1 != 0 or k2 != 0):
        raise InputError(f"{where}: distortion is {k1:g} {k2:g}, expected 0 0: photos must be undistorted first "
                         "(Bundler's RadialUndistort, then bundle.rd.out)")
    R = np.array([_three(row, f"{where}: rotation") for row in rows[1:4]])
    return f, R, _three(rows[4], f"{where}: translation")


def _three(row: Sequence[str], what: str) -> np.ndarray:
    if len(row) != 3:
        raise InputError(f"{what} has {len(row)} numbers, expected 3")
    return untrusted.words(row, what)


def write(folder: Path, views: list[View]) -> Path:
    """Write bundle.out and list.txt.

    InputError where the format would lose something: a principal point that is not the middle, or fx unlike fy.
    """
    folder = Path(folder)
    rows, names = ["# Bundle file v0.3", f"{len(views)} 0"], []
    for view in views:
        camera = view.camera
        if max(abs(camera.cx - camera.width / 2), abs(camera.cy - camera.height / 2)) > 1e-9 * camera.width:
            raise InputError(f"view {view.name!r}: the principal point ({camera.cx:g}, {camera.cy:g}) is not the "
                             "photo's middle, and Bundler's format cannot hold it; write another format")
        if abs(camera.fx - camera.fy) > 1e-9 * camera.fx:
            raise InputError(f"view {view.name!r}: fx {camera.fx!r} and fy {camera.fy!r} differ, and Bundler's format "
                             "holds one focal length; write another format")
        pose = _FLIP @ camera.world_to_camera[:3]
        rows.append(f"{camera.fx!r} 0 0")
        rows += [" ".join(repr(float(v)) for v in row) for row in (*pose[:, :3], pose[:, 3])]
        names.append(photos.file_of(view).relative_to(folder).as_posix())
    untrusted.write_text(folder / LISTS[0], "\n".join(names) + "\n")
    return untrusted.write_text(folder / FILES[0], "\n".join(rows) + "\n")
