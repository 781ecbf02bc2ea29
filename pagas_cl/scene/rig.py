"""What the cameras as a whole look at, and how kernels read them."""

import numpy as np

from pagas_cl.scene.camera import Camera


def viewing_distance(cameras: list[Camera]) -> float:
    """Median distance of the cameras from the point nearest to all viewing axes (the paper's unit of the rate).

    NaN where there is none: the axes are parallel, or it lies behind most cameras.
    """
    centers = np.array([camera.center for camera in cameras])
    axes = np.array([camera.direction for camera in cameras])
    origin = centers[0]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]  # projects onto the plane across each axis
    normal_matrix = across.sum(axis=0)
    if np.linalg.eigvalsh(normal_matrix)[0] < 1e-6 * len(cameras):
        return float("nan")
    point = np.linalg.solve(normal_matrix, np.einsum("nij,nj->i", across, centers - origin))
    to_point = point - (centers - origin)
    if ((to_point * axes).sum(axis=1) > 0).mean() <= 0.5:
        return float("nan")
    return float(np.median(np.linalg.norm(to_point, axis=1)))


def footprint(target: Camera, context: Camera, scene_scale: float) -> float:
    """Size of `context`'s pixel at the middle of the target at depth `scene_scale`, in units; 0 behind it."""
    rotation, tau = context.relative_to(target)
    z = rotation[2, 2] + tau[2] / scene_scale
    return max(0.0, float(z)) / float(np.sqrt(context.fx * context.fy))


def camera_table(target: Camera, contexts: list[Camera], scene_scale: float) -> np.ndarray:
    """The cameras as camera.clh reads them, target first, lengths in `scene_scale`: float32 (1 + contexts, 20)."""
    rows = []
    for camera in (target, *contexts):
        rotation, tau = camera.relative_to(target)
        rows.append([*rotation.ravel(), *(tau / scene_scale), camera.fx, camera.fy, camera.cx, camera.cy, 1 / camera.fx,
                     1 / camera.fy, camera.width, camera.height])
    return np.array(rows, np.float32)
