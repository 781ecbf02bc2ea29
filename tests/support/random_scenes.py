"""Small random scenes that meet every branch: a step in depth, holes, views of other sizes and focal lengths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from support.hard_scenes import camera as camera_at
from twins.photo_loss import Photo

GAINS = np.array([[[0.8, 0.05], [0.9, 0.02], [1.1, -0.03]], [[1.3, -0.1], [1.0, 0.0], [0.7, 0.1]]])


def rotation(axis_angle) -> np.ndarray:
    """Rotation matrix of an axis times an angle in radians (Rodrigues)."""
    x, y, z = axis_angle
    angle = np.linalg.norm(axis_angle)
    S = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    if angle == 0:
        return np.eye(3)
    return np.eye(3) + np.sin(angle) / angle * S + (1 - np.cos(angle)) / angle**2 * S @ S


def pose(R, center) -> np.ndarray:
    """World-to-camera 4x4 of a camera with rotation R at `center`."""
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3] = R
    world_to_camera[:3, 3] = -R @ np.asarray(center, np.float64)
    return world_to_camera


def random_image(rng, width: int, height: int) -> np.ndarray:
    """8-bit colours as float64 in 0..1: smooth texture with some noise."""
    noise = rng.random((height + 4, width + 4, 3))
    smooth = sum(noise[i:i + height, j:j + width] for i in range(5) for j in range(5)) / 25
    image = 0.5 + 3 * (smooth - 0.5) + 0.05 * rng.standard_normal(smooth.shape)
    return np.rint(np.clip(image, 0, 1) * 255) / 255


def random_depth(rng, width: int, height: int, scale: float = 1.0) -> np.ndarray:
    """A wavy slope with a nearer block and a few holes, about 1 * `scale` deep."""
    v, u = np.mgrid[:height, :width] / max(width, height)
    depth = 1 + 0.15 * u - 0.1 * v + 0.02 * np.sin(9 * u + 4 * v) + 0.004 * rng.standard_normal(u.shape)
    depth[height // 4:height // 2, width // 3:width // 2] *= 0.8
    depth[rng.random(depth.shape) < 0.02] = 0
    return depth * scale


def gains(contexts: int) -> np.ndarray:
    """Gain and offset of each channel for each context view, some of which clip: shape (contexts, 3, 2)."""
    return np.array([GAINS[k % len(GAINS)] for k in range(contexts)])


def exposed(contexts: list[Photo]) -> list[Photo]:
    """The context photos with `gains`."""
    return [replace(photo, exposure=gain) for photo, gain in zip(contexts, gains(len(contexts)))]


def random_scene(seed: int, width: int = 20, height: int = 16, contexts: int = 3, masks: bool = False,
                 scale: float = 1.0, offset=(0.0, 0.0, 0.0)):
    """Depth (height, width), target Photo, context Photos; the scene scaled by `scale`, then moved by `offset`."""
    rng = np.random.default_rng(seed)
    offset = np.asarray(offset, np.float64)
    f = 1.2 * width
    depth = random_depth(rng, width, height, scale)
    R0 = rotation(0.3 * rng.standard_normal(3))
    center = rng.standard_normal(3)

    def photo(R, at, w, h, fx, fy, name):
        middle = w / 2 + rng.normal(), h / 2 + rng.normal()
        camera = camera_at((w, h), (fx, fy), at * scale + offset, R, middle, name)
        mask = rng.random((h, w)) > 0.1 if masks and name != "target" else None
        return Photo(camera, random_image(rng, w, h), mask)

    target = photo(R0, center, width, height, f, 1.05 * f, "target")
    views = []
    for i in range(contexts):
        shift = 0.15 * rng.standard_normal(3) + (0.1 * (-1) ** i, 0, 0)
        turn = rotation(0.05 * rng.standard_normal(3) + (-shift[1], shift[0], 0))  # looks at about (0, 0, 1)
        zoom = (1.0, 1.45, 0.8)[i % 3]  # sparser and denser Gaussians: S below and above 1
        size = (1.0, 1.2, 0.9)[i % 3]
        views.append(photo(turn @ R0, center + R0.T @ shift, int(size * width), int(size * height), zoom * f,
                           1.1 * zoom * f, f"context {i}"))
    return depth, target, views
