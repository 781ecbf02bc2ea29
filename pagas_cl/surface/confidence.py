"""Confidence of depth maps, carried to the vertices of a mesh (MeshLab's vertex quality)."""

from __future__ import annotations

import numpy as np

from pagas_cl.scene.camera import Camera

_NEAR = 3.0  # footprints between a vertex and the depth map that it is seen in


def vertex_confidence(vertices: np.ndarray, cameras: list[Camera], depths: list[np.ndarray],
                      confidences: list[np.ndarray]) -> np.ndarray:
    """Mean confidence (0 to 1) of the views that see each vertex, float64 of shape (V,); 0 where none does.

    Parameters
    ----------
    vertices : ndarray of shape (V, 3), world coordinates
    depths, confidences : lists of arrays (H, W), one a camera
    """
    total, count = np.zeros(len(vertices)), np.zeros(len(vertices))
    for camera, depth, confidence in zip(cameras, depths, confidences):
        uv, z = camera.project(vertices)
        with np.errstate(invalid="ignore"):
            seen = (z > 0) & (uv >= 0).all(axis=1) & (uv < (camera.width, camera.height)).all(axis=1)
        index = np.flatnonzero(seen)
        place = uv[index].astype(np.intp)
        found = depth[place[:, 1], place[:, 0]]
        near = (found > 0) & (np.abs(found - z[index]) < 10 * _NEAR * z[index] / np.sqrt(camera.fx * camera.fy))
        index, place = index[near], place[near]
        total[index] += confidence[place[:, 1], place[:, 0]]
        count[index] += 1
    return total / np.maximum(count, 1)
