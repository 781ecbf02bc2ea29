"""First rotations of cameras that are farther off than coarse photos reach: whole photos are laid upon one another
(method section 9)."""

from collections.abc import Sequence

import numpy as np

from pagas_cl.method.cameras.motion import cross_matrix, exponential, placed
from pagas_cl.scene.camera import Camera

_ALIKE = 0.3              # correlation of whole photos from which the offset between them is believed
_OVERLAP = 0.3            # share of what one sees that the other has to show
_FARTHEST = 0.25          # of a photo's width: what is offset farther looks alike by chance
_ROUNDS = 10              # of weights, which leave out pairs that others contradict
_HOLD = 1e-3              # of what photos do not see, such as the roll: it stays


def initial_rotations(cameras: Sequence[Camera], normals: Sequence[np.ndarray], depths: Sequence[np.ndarray],
                      pairs: Sequence[tuple[int, int]]) -> tuple[list[np.ndarray], float]:
    """Rotations (3, 3) of each camera about its centre, in the world, that bring whole photos upon one another, and by
    how many pixels these are offset (median over the pairs; NaN where none of them is alike).

    `normals` (H, W): normalised photos, NaN where masked; `depths` (H, W), scene units; both of the size of `cameras`.
    """
    rows, sides, places = [], [], []
    for one, other in pairs:
        camera, point = cameras[one], _middle(cameras[one], depths[one])
        offset = None if point is None else _offset(camera, cameras[other], normals[one], normals[other], depths[one])
        if offset is not None:
            x = camera.world_to_camera[:3, :3] @ (point - camera.center)
            pixels = [[camera.fx], [camera.fy]] * (np.eye(3)[:2] - np.outer(x[:2] / x[2], [0, 0, 1])) / x[2]
            rows.append(pixels @ camera.world_to_camera[:3, :3] @ np.hstack(      # what a photo shows rotates with it
                [cross_matrix(point - camera.center), -cross_matrix(point - cameras[other].center)]))
            sides.append(offset)
            places.append(np.r_[3 * one:3 * one + 3, 3 * other:3 * other + 3])
    if not rows:
        return [np.eye(3)] * len(cameras), float("nan")
    A, b, at, weights = np.array(rows), np.array(sides), np.array(places), np.ones(len(rows))
    for _ in range(_ROUNDS):
        matrix, right = np.zeros((3 * len(cameras),) * 2), np.zeros(3 * len(cameras))
        np.add.at(matrix, (at[:, :, None], at[:, None]), np.einsum("n,nij,nik->njk", weights, A, A))
        np.add.at(right, at, np.einsum("n,nij,ni->nj", weights, A, b))
        steps = np.linalg.solve(matrix + _HOLD * np.trace(matrix) / len(right) * np.eye(len(right)), right)
        weights = 1 / np.maximum(1.0, np.linalg.norm(np.einsum("nij,nj->ni", A, steps[at]) - b, axis=1))
    return ([exponential(np.concatenate([rotation, np.zeros(3)]))[0] for rotation in steps.reshape(-1, 3)],
            float(np.median(np.linalg.norm(b, axis=1))))


def rotated(camera: Camera, rotation: np.ndarray) -> Camera:
    """The camera rotated about its centre by a rotation of initial_rotations."""
    return placed(camera, camera.world_to_camera[:3, :3] @ rotation.T, camera.center)


def _middle(camera: Camera, depth: np.ndarray) -> np.ndarray | None:
    """A point of the surface in the middle of what the camera sees, in the world."""
    rows, columns = np.nonzero(depth > 0)
    if not len(rows):
        return None
    ray = camera.rays_at(rows, columns).mean(axis=0)
    return (ray * np.median(depth[rows, columns])) @ camera.world_to_camera[:3, :3] + camera.center


def _offset(camera: Camera, other: Camera, own: np.ndarray, others: np.ndarray, depth: np.ndarray) -> np.ndarray | None:
    """Pixels (x, y) from where `own` shows something to where `others` does, seen through the surface: the shift at
    which they correlate best; None where they do at none."""
    height, width = depth.shape
    points = (camera.rays() * depth[..., None]) @ camera.world_to_camera[:3, :3] + camera.center
    uv, z = other.project(points.reshape(-1, 3))
    seen = (depth.ravel() > 0) & other.holds(uv, z)
    column, row = np.floor(uv[seen]).astype(int).T
    there = np.full(depth.size, np.nan, np.float32)
    there[seen] = others[row, column]
    there = there.reshape(depth.shape)
    known, known_there = np.isfinite(own), np.isfinite(there)
    own, there = np.nan_to_num(own), np.nan_to_num(there)

    def at_all_shifts(a, b):
        size = (2 * height, 2 * width)
        return np.fft.irfft2(np.conj(np.fft.rfft2(a, size)) * np.fft.rfft2(b, size), size)

    number = at_all_shifts(known_there, known)
    squares = at_all_shifts(there**2, known) * at_all_shifts(known_there, own**2)
    alike = at_all_shifts(there, own) / np.sqrt(np.maximum(squares, 1e-6))
    alike[number < max(_OVERLAP * known_there.sum(), 1)] = -1
    far = int(_FARTHEST * width)
    alike[far:-far], alike[:, far:-far] = -1, -1
    best = int(alike.argmax())
    if alike.flat[best] < _ALIKE:
        return None
    y, x = np.unravel_index(best, alike.shape)
    return np.array([x - 2 * width if x >= width else x, y - 2 * height if y >= height else y], float)
