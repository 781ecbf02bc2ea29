"""What depth maps and photos say of the vertices of a mesh: size of a pixel, confidence, colour."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from pagas_cl.scene.camera import Camera
from pagas_cl.scene.depthmap import confidence_of
from pagas_cl.scene.view import View

_PART = 1 << 14   # vertices at a time: what is made of them stays in the cache
_ON_MAP = 30.0   # footprints between a vertex and a depth map that it is said to lie on
_ON_PHOTO = 3.0  # or that it has the colour of


def footprints(vertices: np.ndarray, cameras: list[Camera], depths: Iterable[np.ndarray]) -> np.ndarray:
    """Size of a pixel at each vertex in the view that sees it finest, scene units; infinite where no view does."""
    finest = np.full(len(vertices), np.inf)
    for camera, depth in zip(cameras, depths):
        for index, _, size in _seen(vertices, camera, depth):
            finest[index] = np.minimum(finest[index], size)
    return finest


def vertex_confidence(vertices: np.ndarray, results) -> np.ndarray:
    """Mean confidence (0 to 1) of the DepthResults that see each vertex, float64 of shape (V,); 0 where none does."""
    total, count = np.zeros(len(vertices)), np.zeros(len(vertices))
    for result in results:
        maps = [part.reshape(-1) for part in (result.depth, result.deviation, result.parallax)]
        for index, pixel, _ in _seen(vertices, result.camera, result.depth):
            total[index] += confidence_of(*(part[pixel] for part in maps))
            count[index] += 1
    return total / np.maximum(count, 1)


def vertex_colors(vertices: np.ndarray, views: Sequence[View], results: Sequence[Any],
                  given: np.ndarray | None = None) -> np.ndarray:
    """Colours (V, 3) from 0 to 1 of vertices: the mean of the photos that see them, of finer ones more (one over the
    squared size of a pixel); where none does, those `given`, or grey. A view's result comes at its place."""
    total, weights = np.zeros((len(vertices), 3)), np.zeros(len(vertices))
    for view, result in zip(views, results):
        photo, mask = view.load_image().reshape(-1, 3), view.load_mask()
        for index, pixel, size in _seen(vertices, result.camera, result.depth, _ON_PHOTO):
            weight = 1 / size**2 if mask is None else mask.reshape(-1)[pixel] / size**2
            total[index] += weight[:, None] * photo[pixel]
            weights[index] += weight
    seen = (weights > 0)[:, None]
    grey = np.full_like(total, 0.5) if given is None else given
    return np.where(seen, total / np.where(seen, 255 * weights[:, None], 1), grey)


def _seen(vertices: np.ndarray, camera: Camera, depth: np.ndarray, within: float = _ON_MAP):
    """By parts: indices of vertices `within` so many footprints of the depth map, their pixels, pixels' sizes."""
    for start in range(0, len(vertices), _PART):
        uv, z = camera.project(vertices[start:start + _PART])
        index = np.flatnonzero(camera.holds(uv, z))
        z, pixel = z[index], uv[index, 1].astype(np.intp) * camera.width + uv[index, 0].astype(np.intp)
        size, found = z / np.sqrt(camera.fx * camera.fy), depth.reshape(-1)[pixel]
        near = np.flatnonzero((found > 0) & (np.abs(found - z) < within * size))
        yield start + index[near], pixel[near], size[near]
