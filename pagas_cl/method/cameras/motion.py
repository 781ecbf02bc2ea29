"""How cameras move: twists (turning first, then shift) on the left of world_to_camera, and what a photo sees of one."""

from dataclasses import replace

import numpy as np

from pagas_cl.scene.camera import Camera
from pagas_cl.scene.sampling import sample_pixels


def cross_matrix(v: np.ndarray) -> np.ndarray:
    """[v]x, (3, 3)."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def exponential(twist: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3, 3) and shift (3,) of a twist (6,)."""
    w, v = twist[:3], twist[3:]
    angle, W = float(np.linalg.norm(w)), cross_matrix(w)
    if angle < 1e-4:         # the series, beyond which nothing is left in float64
        a, b, c = 1 - angle**2 / 6, 0.5 - angle**2 / 24, 1 / 6 - angle**2 / 120
    else:
        a, b = np.sin(angle) / angle, (1 - np.cos(angle)) / angle**2
        c = (1 - a) / angle**2
    return np.eye(3) + a * W + b * W @ W, (np.eye(3) + b * W + c * W @ W) @ v


def moved(camera: Camera, twist: np.ndarray, scene_scale: float = 1.0) -> Camera:
    """The camera after a twist, whose shift is in units of `scene_scale`."""
    turn, shift = exponential(np.asarray(twist, np.float64))
    rotation = turn @ camera.world_to_camera[:3, :3]
    u, _, vt = np.linalg.svd(rotation)       # steps add up
    return placed(camera, u @ vt, camera.center - rotation.T @ shift * scene_scale)


def placed(camera: Camera, rotation: np.ndarray, center: np.ndarray) -> Camera:
    """The camera with another pose: world to camera (3, 3), and its centre (3,) in scene units."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ center
    return replace(camera, world_to_camera=pose)


def twist_between(given: Camera, now: Camera, scene_scale: float = 1.0) -> np.ndarray:
    """The twist (6,) that moves `given` to `now`."""
    turn = now.world_to_camera[:3, :3] @ given.world_to_camera[:3, :3].T
    shift = now.world_to_camera[:3, :3] @ (given.center - now.center) / scene_scale
    sine = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    size, cosine = float(np.linalg.norm(sine)), 0.5 * (np.trace(turn) - 1)
    w = sine * (np.arctan2(size, cosine) / size if size > 1e-12 else 1.0)
    V = np.array([exponential(np.concatenate([w, axis]))[1] for axis in np.eye(3)]).T
    return np.concatenate([w, np.linalg.solve(V, shift)])


def adjoint(rotation: np.ndarray, tau: np.ndarray) -> np.ndarray:
    """What a twist of the target is as one of the other camera, (6, 6), of the pose from target to other."""
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = rotation
    out[3:, :3] = cross_matrix(tau) @ rotation
    return out


def pixel_motion(given: Camera, now: Camera, points: np.ndarray) -> float:
    """By how many pixels world `points` (N, 3) move in the photo from one camera to the other, root mean square; NaN
    where there are none in front of both."""
    (uv, z), (other, z_other) = given.project(points), now.project(points)
    front = (z > 0) & (z_other > 0)
    return float(np.sqrt(((uv - other)[front] ** 2).sum(-1).mean())) if front.any() else float("nan")


def surface_points(camera: Camera, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Some points of a depth map (H, W) in the world (n, 3), and their depths (n,)."""
    depth = np.where(np.isfinite(depth), depth, 0)
    if not (depth > 0).any():
        return np.zeros((0, 3)), np.zeros(0)
    rows, columns = sample_pixels(depth, 2000)
    z = depth[rows, columns].astype(np.float64)
    return (camera.rays_at(rows, columns) * z[:, None]) @ camera.world_to_camera[:3, :3] + camera.center, z
