"""Where the world is, where a mesh says it: a similarity of all cameras, which no photo sees (method section 9)."""

from collections.abc import Callable, Sequence

import numpy as np

from pagas_cl.method.cameras.motion import cross_matrix, exponential, placed
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.depthmap import central_normals
from pagas_cl.scene.sampling import sample_pixels

_POINTS = 1000            # of a view
_ROUNDS = 10              # of weights
_OUTLIER = 1.0            # footprints: what is farther off counts linearly
_STEEP = 0.2              # least cosine between a ray and the mesh's normal
_LEAST = 1e-4             # squared footprints that a mesh is taken to be off by, at least


def register_to_mesh(cameras: Sequence[Camera], depths: Sequence[np.ndarray], drawn: Sequence[np.ndarray],
              spread: float) -> Callable[[Camera], Camera]:
    """What moves each camera with the similarity that brings the surface of `depths` (H, W), scene units, nearest to
    the mesh, which is `drawn` through the same cameras.

    Least squares of the distances from one to the other along the mesh's normals, footprints, of every view one mean;
    cameras are off by `spread` pixels, so that they hold where they are what the mesh does not show.
    """
    middle = np.mean([camera.center for camera in cameras], axis=0)
    of_views = [_distances(*given, middle) for given in zip(cameras, depths, drawn)]
    found = [of_view for of_view in of_views if of_view is not None]
    if not found:
        return lambda camera: camera
    A, b, share, H = (np.concatenate(part) for part in zip(*found))
    left, similarity = b, np.zeros(7)
    for _ in range(_ROUNDS):
        weight = share / np.maximum(1.0, np.abs(left) / _OUTLIER)
        off = max(float((weight * left**2).sum() / weight.sum()), _LEAST)
        similarity = np.linalg.solve((A.T * weight) @ A / off + H.T @ H / max(spread, 1e-3)**2,
                                     (A.T * weight) @ b / off)
        left = b - A @ similarity
    turn, _ = exponential(np.r_[similarity[:3], 0, 0, 0])

    def move(camera: Camera) -> Camera:
        there = middle + similarity[3:6] + np.exp(similarity[6]) * (turn @ (camera.center - middle))
        return placed(camera, camera.world_to_camera[:3, :3] @ turn.T, there)
    return move


def _distances(camera: Camera, depth: np.ndarray, mesh: np.ndarray,
               middle: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None:
    """Of some points (n) of a view: what a similarity about `middle` changes of their distances from the mesh (n, 7),
    these distances (n,), footprints, and their shares (n,); and what it changes of the camera (6, 7), pixels."""
    turn, focal = camera.world_to_camera[:3, :3], 0.5 * (camera.fx + camera.fy)
    both = np.where((depth > 0) & (mesh > 0), depth, 0)
    if not (both > 0).any():
        return None
    v, u = sample_pixels(both, _POINTS)
    rays, n, z = camera.rays_at(v, u), central_normals(mesh, camera)[v, u], both[v, u].astype(np.float64)
    known = np.abs((n * rays).sum(-1)) > _STEEP * np.linalg.norm(rays, axis=-1)
    if not known.any():      # wires, or all of it seen edge-on
        return None
    v, u, rays, n, z = v[known], u[known], rays[known], n[known] @ turn, z[known]
    c = camera.center - middle
    x = (rays * z[:, None]) @ turn + camera.center - middle
    return (np.c_[np.cross(x, n), n, (n * x).sum(-1)] * (focal / z)[:, None],
            (n * ((mesh[v, u] - z)[:, None] * (rays @ turn))).sum(-1) * focal / z, np.full(len(z), 1 / len(z)),
            np.concatenate([focal * np.c_[np.eye(3), np.zeros((3, 4))],
                            focal / np.median(z) * np.c_[-cross_matrix(c), np.eye(3), c]]))
