"""Photos through a lens: what COLMAP's distorted camera models need before a pinhole camera describes them."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from pagas_cl.errors import InputError, need
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.images import bilinear, read_mask, read_photo
from pagas_cl.system.files import translated

_ROWS = 256  # rows of the map made at a time


@dataclass(frozen=True)
class Lens:
    """A calibrated lens (COLMAP's `model` and its `params`) and the pinhole that its photos are resampled to.

    `size`: (width, height) as taken, pixels; `pinhole`: width, height, fx, fy, cx, cy, pixels, centres at +0.5.
    """

    model: str
    params: tuple[float, ...]
    size: tuple[int, int]
    pinhole: tuple[int, int, float, float, float, float]

    @classmethod
    def from_colmap(cls, camera: Any, name: str = "") -> "Lens":
        """The lens of a pycolmap Camera; the pinhole is the one that `colmap image_undistorter` would choose."""
        pycolmap = need("pycolmap", "colmap", "undistorting photos")
        with translated(f"camera of image {name!r} is {camera.model.name} and cannot be undistorted (",
                        "); undistort first: colmap image_undistorter (a panorama: cut it into pinhole photos)"):
            pinhole = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
            found = (int(pinhole.width), int(pinhole.height), pinhole.focal_length_x, pinhole.focal_length_y,
                     pinhole.principal_point_x, pinhole.principal_point_y)
            if not np.isfinite(found).all() or min(found[:2]) < 1:
                raise ValueError("it has no pinhole equivalent")
        return cls(camera.model.name, tuple(float(p) for p in camera.params),
                   (int(camera.width), int(camera.height)), found)

    def undistorted(self, pixels: np.ndarray) -> np.ndarray:
        """Resample (H, W) bool or (H, W, 3) uint8 as taken to the pinhole, bilinear; outside the photo: the border."""
        mixed = bilinear(pixels, *_positions(self))
        return mixed > 0.5 if pixels.dtype == bool else np.rint(mixed).astype(np.uint8)

    def undistorted_depth(self, depth: np.ndarray) -> np.ndarray:
        """The same of z-depth (H, W), of the nearest pixel: a mean over an edge is on neither side; 0 outside."""
        x, y = _positions(self)
        column, row = np.floor(x).astype(np.intp), np.floor(y).astype(np.intp)
        inside = (column >= 0) & (row >= 0) & (column < self.size[0]) & (row < self.size[1])
        return np.asarray(depth[np.clip(row, 0, self.size[1] - 1), np.clip(column, 0, self.size[0] - 1)] * inside)


@dataclass(frozen=True)
class ThroughLens:
    """A photo's or mask's file that is undistorted each time it is loaded."""

    path: Path
    lens: Lens
    kind: str = "image"

    def load(self) -> np.ndarray:
        pixels = (read_mask if self.kind == "mask" else read_photo)(self.path)
        size = self.lens.size
        if pixels.shape[1::-1] != size:
            raise InputError(f"{self.kind} {str(self.path)!r} is {pixels.shape[1]} x {pixels.shape[0]}, its camera "
                             f"says {size[0]} x {size[1]}: a distorted photo cannot be rescaled here")
        return self.lens.undistorted(pixels)


@lru_cache(maxsize=2)
def _positions(lens: Lens) -> tuple[np.ndarray, np.ndarray]:
    """Where each pinhole pixel lies in the photo as taken: x and y, float32 (height, width), centres at +0.5."""
    pycolmap = need("pycolmap", "colmap", "undistorting photos")
    camera = pycolmap.Camera(model=lens.model, width=lens.size[0], height=lens.size[1], params=list(lens.params))
    pinhole = Camera(*lens.pinhole, np.eye(4))
    place = np.empty((pinhole.height, pinhole.width, 2), np.float32)
    for start in range(0, pinhole.height, _ROWS):
        part = place[start:start + _ROWS]
        part[:] = np.reshape(camera.img_from_cam(pinhole.rays(start, len(part)).reshape(-1, 3)), part.shape)
    if not np.isfinite(place).all():
        raise InputError(f"camera model {lens.model} has no image for some of the undistorted pixels; undistort first: "
                         "colmap image_undistorter")
    return place[..., 0], place[..., 1]
