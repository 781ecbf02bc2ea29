"""What every export of a recording is made of: photos with cameras and depth, as they are and as a network saw them."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from PIL import Image

from pagas_cl.scene.camera import Camera
from pagas_cl.scene.depth.formats import PATCH
from pagas_cl.scene.depth.placement import Placement, stretched
from pagas_cl.scene.depthmap import save_depth
from pagas_cl.scene.images import bilinear, photo_to
from pagas_cl.scene.readers.meshlab import row
from pagas_cl.scene.view import View

NETWORK = 4          # photos are so many times as large as what a network sees


@dataclass(frozen=True, eq=False)
class Frame:
    """One photo (H, W, 3) uint8 with its camera, z-depth (H, W) float32 and, from 1 on, the confidence in it."""

    camera: Camera
    photo: np.ndarray = field(repr=False)
    depth: np.ndarray = field(repr=False)
    confidence: np.ndarray | None = field(default=None, repr=False)

    @property
    def sure(self) -> np.ndarray:
        """The confidence, 2 where none is given."""
        return np.full(self.depth.shape, 2, np.float32) if self.confidence is None else self.confidence


def photos(folder: Path, frames: Sequence[Frame], place: str = "images", name: str = "{:06d}.png") -> list[View]:
    """Write the photos; the views that they are."""
    (folder / place).mkdir(parents=True, exist_ok=True)
    views = []
    for k, frame in enumerate(frames):
        path = folder / place / name.format(k)
        Image.fromarray(frame.photo).save(path)
        views.append(View(frame.camera, path, None, path.name))
    return views


def network_size(width: int, height: int, share: float = 1 / NETWORK) -> tuple[int, int]:
    """Sides that are multiples of 14, as near to `share` of the photo's as can be."""
    return max(1, round(width * share / PATCH)) * PATCH, max(1, round(height * share / PATCH)) * PATCH


def seen(frame: Frame, placement: Placement, size: tuple[int, int]) -> Frame:
    """What a network of image size (width, height) saw: the small photo, its camera, depth and confidence there."""
    (sx, sy), (ox, oy), camera = placement.scale, placement.offset, frame.camera
    x, y = np.meshgrid((np.arange(size[0]) + 0.5 - ox) / sx, (np.arange(size[1]) + 0.5 - oy) / sy)
    inside = (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
    rough = photo_to(frame.photo, max(1, round(camera.width * sx)), max(1, round(camera.height * sy)))
    small = np.rint(bilinear(rough, x * rough.shape[1] / camera.width, y * rough.shape[0] / camera.height))
    rows, columns = np.clip(y, 0, camera.height - 1).astype(int), np.clip(x, 0, camera.width - 1).astype(int)
    K = Camera(*size, sx * camera.fx, sy * camera.fy, sx * camera.cx + ox, sy * camera.cy + oy, camera.world_to_camera)
    return Frame(K, np.where(inside[..., None], small, 255).astype(np.uint8),
                 np.where(inside, frame.depth[rows, columns], 0).astype(np.float32),
                 np.where(inside, frame.sure[rows, columns], 1).astype(np.float32))


def small_of(frames: Sequence[Frame]) -> list[Frame]:
    size = frames[0].camera.width, frames[0].camera.height
    small = network_size(*size)
    return [seen(frame, stretched(size, small), small) for frame in frames]


def depth_maps(folder: Path, frames: Sequence[Frame]) -> None:
    for k, frame in enumerate(frames):
        save_depth(folder / f"{k:06d}.npz", frame.depth)


def png(folder: Path, frames: Sequence[Frame], name: str, scale: float, none: int = 0) -> None:
    for k, frame in enumerate(frames):
        path = folder / name.format(k)
        path.parent.mkdir(parents=True, exist_ok=True)
        values = np.where(frame.depth > 0, np.rint(frame.depth * scale).clip(0, 65534), none)
        Image.fromarray(values.astype(np.uint16)).save(path)


def matrix(values: np.ndarray) -> str:
    return "".join(row(line) + "\n" for line in values)
