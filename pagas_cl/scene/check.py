"""Do the cameras see the mesh, and if not, which other reading of the poses would?"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from pagas_cl.errors import InputError
from pagas_cl.scene.camera import Camera, inverse_pose
from pagas_cl.scene.mesh import Surface

_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
_SAMPLES = 20_000
_CHANCE = 0.0005    # share of the mesh that a wrong reading may have in an image by chance; a city's view has more
_WORK = 20_000_000  # camera-point pairs of one reading of the poses

# reading of the pose -> (what it does to world_to_camera, what it is called, which constructor mends it)
_READINGS = {
    "inverse": (inverse_pose, "with the inverse matrices", "Camera.from_c2w(...)"),
    "opengl": (lambda pose: _FLIP @ pose, "with y and z flipped (OpenGL axes)", "Camera.from_opengl_c2w(...)"),
    "inverse opengl": (lambda pose: _FLIP @ inverse_pose(pose),
                       "with the inverse matrices and y and z flipped (OpenGL axes)", "Camera.from_opengl_c2w(...)"),
}


def check_seen(surface: Surface | np.ndarray, cameras: list[Camera]) -> npt.NDArray[np.float64]:
    """Raise InputError when the poses are such that hardly a camera sees the mesh, saying which reading would mend it.

    Parameters
    ----------
    surface : Surface, or ndarray of shape (V, 3)
        The mesh, or its vertices, world coordinates.
    cameras : list of Camera

    Returns
    -------
    ndarray of shape (N,), float64
        Share of the mesh's points in front of and inside each camera's image.
    """
    if not cameras:
        raise InputError("there are no cameras: nothing can be refined")
    points = sample_points(surface, min(_SAMPLES, max(500, _WORK // len(cameras))))
    inside, front = _shares(points, cameras)
    seeing = int(np.count_nonzero(inside))
    count = len(cameras)
    if 2 * seeing >= count:
        return inside
    better: dict[str, int] = {}
    for name, (change, _, _) in _READINGS.items():
        changed = [replace(camera, world_to_camera=change(camera.world_to_camera)) for camera in cameras]
        better[name] = int(np.count_nonzero(_shares(points, changed)[0] > _CHANCE))
    best = max(better, key=better.__getitem__)  # the first of equals: the simplest reading
    mends = better[best] >= 0.9 * count if seeing else better[best] >= max(1, 0.5 * count)
    if mends:
        _, what, constructor = _READINGS[best]
        raise InputError(f"{_who(seeing, count, front)}; {what} {better[best]} of {count} do: pass {constructor}")
    if seeing == 0:
        raise InputError(f"{_who(seeing, count, front)}, nor do more with inverse matrices or OpenGL axes: "
                         f"{_places(points, cameras)}; are mesh and cameras in the same frame and unit?")
    return inside


def sample_points(surface: Surface | np.ndarray, count: int) -> npt.NDArray[np.float64]:
    """Up to `count` vertices, evenly taken, and as many points on the faces, by area: float64 of shape (N, 3).

    The same points each time. Faces matter where triangles are larger than a photo's view.
    """
    vertices = surface.vertices if isinstance(surface, Surface) else np.asarray(surface, np.float64)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or len(vertices) == 0:
        raise InputError(f"vertices have shape {vertices.shape}, expected (V, 3) with at least one")
    points = vertices[np.unique(np.linspace(0, len(vertices) - 1, min(count, len(vertices))).astype(np.intp))]
    if not isinstance(surface, Surface):
        return points
    a, b, c = (vertices[surface.faces[:, k]] for k in range(3))
    area = np.cumsum(np.linalg.norm(np.cross(b - a, c - a), axis=1))
    if not area[-1] > 0:
        return points
    at = np.searchsorted(area, (np.arange(count) + 0.5) / count * area[-1]).clip(max=len(area) - 1)
    step = np.arange(count)
    r, s = (0.5 + step * 0.7548776662466927) % 1, (0.5 + step * 0.5698402909980532) % 1  # plastic-number sequence
    fold = r + s > 1
    r, s = np.where(fold, 1 - r, r)[:, None], np.where(fold, 1 - s, s)[:, None]
    return np.concatenate([points, a[at] + r * (b[at] - a[at]) + s * (c[at] - a[at])])


def _shares(points: np.ndarray, cameras: list[Camera]) -> tuple[np.ndarray, np.ndarray]:
    """Share of the points inside each image, and in front of each camera."""
    inside, front = np.zeros(len(cameras)), np.zeros(len(cameras))
    for i, camera in enumerate(cameras):
        uv, z = camera.project(points)
        ahead = z > 0
        seen = ahead & (uv >= 0).all(axis=1) & (uv < (camera.width, camera.height)).all(axis=1)
        inside[i], front[i] = seen.mean(), ahead.mean()
    return inside, front


def _who(seeing: int, count: int, front: np.ndarray) -> str:
    behind = int(np.count_nonzero(front < 0.5))
    sentence = f"{seeing} of {count} cameras see the mesh"
    return f"{sentence}, it lies behind {behind} of {count}" if behind else sentence


def _places(points: np.ndarray, cameras: list[Camera]) -> str:
    centers = np.array([camera.center for camera in cameras])

    def box(places: np.ndarray) -> str:
        low, high = places.min(axis=0), places.max(axis=0)
        return f"({', '.join(f'{v:.4g}' for v in low)}) to ({', '.join(f'{v:.4g}' for v in high)})"

    return f"the mesh spans {box(points)}, the cameras are at {box(centers)}"
