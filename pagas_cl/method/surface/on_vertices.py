"""What depth maps say of the vertices of a mesh that lie on them: size of a pixel there, confidence."""

from collections.abc import Iterable

import numpy as np

from pagas_cl.scene.camera import Camera
from pagas_cl.scene.depthmap import confidence_of

_PART = 1 << 14   # vertices at a time: what is made of them stays in the cache
_ON_MAP = 30.0   # footprints between a vertex and a depth map that it is said to lie on


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


def _seen(vertices: np.ndarray, camera: Camera, depth: np.ndarray):
    """By parts: indices of the vertices on the depth map; their pixels, by rows; the size of a pixel at each."""
    for start in range(0, len(vertices), _PART):
        uv, z = camera.project(vertices[start:start + _PART])
        index = np.flatnonzero(camera.holds(uv, z))
        z, pixel = z[index], uv[index, 1].astype(np.intp) * camera.width + uv[index, 0].astype(np.intp)
        size, found = z / np.sqrt(camera.fx * camera.fy), depth.reshape(-1)[pixel]
        near = np.flatnonzero((found > 0) & (np.abs(found - z) < _ON_MAP * size))
        yield start + index[near], pixel[near], size[near]
