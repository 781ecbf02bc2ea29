"""IDR's and NeuS's cameras.npz / cameras_sphere.npz: projection matrices `world_mat_i`, with `scale_mat_i`.

Convention: x ~ world_mat_i[:3] (X, 1), OpenCV axes, world-to-camera, in the scene's own world (DTU: millimetres).
scale_mat_i takes the unit sphere, in which NeuS works, to that world. Where the pixel centres are is not said.
"""

import re
import zipfile
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from pagas_cl.errors import InputError, log
from pagas_cl.scene import untrusted
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.npy_files import members, read_member
from pagas_cl.scene.readers import photos
from pagas_cl.scene.view import Scene
from pagas_cl.system.files import opened, translated

FILES = ("cameras_sphere.npz", "cameras.npz", "cameras_large.npz")
EXPECTED = f"{' or '.join(FILES)} with world_mat_0, world_mat_1, ..."
_KEY = re.compile(r"(world_mat|scale_mat)_(\d+)", re.ASCII)
_SKEW_PIXELS = 0.05  # a skew that moves no pixel by more is calibration noise and is dropped
_ENTRIES = 1_000_000


def detect(folder: Path) -> Path | None:
    path = photos.first_file(folder, FILES)
    return path if path and any(name.startswith("world_mat_") for name in members(path)) else None


def read(folder: Path, path: Path, *, frame: str = "world", pixel_center: float = 0.5) -> Scene:
    """Read the views of the photos in `image/` or `images/`.

    `frame`: "world", that of world_mat, or "sphere", the unit sphere of NeuS, in which its own meshes are before they
    are scaled back; `pixel_center`: where the intrinsics put the centre of the top-left pixel. A photo belongs to the
    matrices of its number where the names are such numbers (000023.png: world_mat_23), else photos and matrices are
    matched in order and must be equally many.
    """
    if frame not in ("world", "sphere"):
        raise InputError(f"frame is {frame!r}, expected 'world' or 'sphere'")
    matrices = read_matrices(path)
    views = []
    for number, photo in _matched(photos.scene_photos(folder, ("image", "images", "rgb")), matrices, path):
        world = matrices[number]["world_mat"]
        if frame == "sphere":
            if "scale_mat" not in matrices[number]:
                raise InputError(f"{path} has no scale_mat_{number}, which frame='sphere' needs")
            world = world @ matrices[number]["scale_mat"]
        width, height = photos.photo_size(photo)
        camera = camera_from_projection(world[:3], width, height, photo.name, pixel_center)
        views.append(photos.view_of(folder, camera, photo))
    return Scene(views=views, source=f"{path} (IDR/NeuS)")


def _matched(images: list[Path], matrices: dict[int, dict[str, np.ndarray]], path: Path) -> Iterable[tuple[int, Path]]:
    keys = sorted(n for n in matrices if "world_mat" in matrices[n])
    numbered = {int(p.stem): p for p in images if re.fullmatch(r"\d{1,9}", p.stem, re.ASCII)}
    if len(images) == len(keys):
        return zip(keys, images)
    if len(numbered) == len(images) and set(numbered) <= set(keys):
        log.warning("%s: %d of its %d cameras have no photo in %s and are left out", path, len(keys) - len(images),
                    len(keys), images[0].parent)
        return sorted(numbered.items())
    raise InputError(f"{path} has {len(keys)} cameras and {images[0].parent} {len(images)} photos, whose names are not "
                     "their numbers; expected one photo a camera, or photos called by the numbers of their cameras")


def read_matrices(path: Path) -> dict[int, dict[str, np.ndarray]]:
    """{number: {"world_mat": (4, 4), "scale_mat": (4, 4)}}, float64; other arrays of the file are left alone."""
    found: dict[int, dict[str, np.ndarray]] = {}
    with translated(f"{path} cannot be read (", "): is the file damaged?"), opened(path) as file:
        archive = zipfile.ZipFile(file)
        if len(archive.infolist()) > _ENTRIES:
            raise InputError(f"{path} has {len(archive.infolist())} entries, expected at most {_ENTRIES}")
        for entry in archive.infolist():
            key = _KEY.fullmatch(entry.filename.removesuffix(".npy"))
            if key:
                of_view = found.setdefault(int(key[2]), {})
                if key[1] in of_view:
                    raise InputError(f"{path}: {key[0]} is there twice")
                of_view[key[1]] = _matrix(archive, entry, f"{path}: {key[0]}")
    if not any("world_mat" in mats for mats in found.values()):
        raise InputError(f"{path} has no world_mat_0, world_mat_1 ...: is it a camera file of IDR or NeuS?")
    return found


def _matrix(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, what: str) -> np.ndarray:
    if entry.file_size > 4096:
        raise InputError(f"{what} has {entry.file_size} bytes, expected a 4 x 4 matrix")
    stored = read_member(archive, entry)
    if stored.shape != (4, 4) or stored.dtype.kind != "f":
        raise InputError(f"{what} is {stored.dtype} of shape {stored.shape}, expected a 4 x 4 matrix of floating point "
                         "numbers")
    values = stored.astype(np.float64)
    if not (np.abs(values) <= 1e25).all():
        raise InputError(f"{what} holds values that are not finite, or above 1e25: is the file damaged?")
    if np.abs(values[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise InputError(f"{what}: the last row is {values[3].tolist()}, expected [0, 0, 0, 1]")
    return values


def camera_from_projection(P: np.ndarray, width: int, height: int, name: str, pixel_center: float) -> Camera:
    """Camera of a projection matrix P = s K [R | t] of shape (3, 4), finite, s any number but 0."""
    what, M = f"camera {name!r}", P[:, :3]
    size = np.abs(M).max()
    if size == 0 or np.linalg.cond(M) > 1e12:
        raise InputError(f"{what}: the left 3x3 part of the projection matrix is singular, which no camera has")
    P = P * (np.sign(np.linalg.det(M / size)) / np.linalg.norm(M[2]))  # the last row of R has length 1, det > 0
    K, R = _rq(P[:, :3])
    shift = abs(K[0, 1]) * max(height - K[1, 2], K[1, 2]) / K[1, 1]
    if shift > _SKEW_PIXELS:
        raise InputError(f"{what}: K has skew {K[0, 1]:g}, which moves pixels by up to {shift:.2g}, expected none; "
                         "undistort the photos first")
    t = np.linalg.solve(K, P[:, 3])
    K[0, 1] = 0.0
    return untrusted.pinhole(K, np.column_stack([R, t]), width, height, name, pixel_center=pixel_center)


def _rq(M: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """M = K R with K upper triangular, its diagonal positive and K[2, 2] = 1, R a rotation (det M > 0)."""
    Q, U = np.linalg.qr(M[::-1].T)
    K, R = U.T[::-1, ::-1], Q.T[::-1]
    signs = np.sign(np.diag(K))
    K, R = K * signs, R * signs[:, None]
    return K / K[2, 2], R
