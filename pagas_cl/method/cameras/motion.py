"""How cameras move (method section 9): twists (turning first, then shift) on the left of world_to_camera, and what a
photo sees of one; initial rotations that lay whole photos upon one another; a similarity of all to a mesh."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from pagas_cl.scene.camera import Camera, rigid
from pagas_cl.scene.depthmap import central_normals_at
from pagas_cl.scene.sampling import sample_pixels

_ALIKE = 0.3              # correlation of whole photos from which the offset between them is believed
_OVERLAP = 0.3            # share of what one sees that the other has to show
_FARTHEST = 0.25          # of a photo's width: what is offset farther looks alike by chance
_ROUNDS = 10              # of weights, which leave out pairs that others contradict
_HOLD = 1e-3              # of what photos do not see, such as the roll: it stays
_POINTS = 1000            # of a view
_OUTLIER = 1.0            # footprints: what is farther off counts linearly
_STEEP = 0.2              # least cosine between a ray and the mesh's normal
_LEAST = 1e-4             # squared footprints that a mesh is taken to be off by, at least


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
    return replace(camera, world_to_camera=rigid(rotation, -rotation @ center))


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
    """Pixels that world `points` (N, 3) move in the photo between two cameras, root mean square; NaN: none in front."""
    (uv, z), (other, z_other) = given.project(points), now.project(points)
    front = (z > 0) & (z_other > 0)
    return float(np.sqrt(((uv - other)[front] ** 2).sum(-1).mean())) if front.any() else float("nan")


def surface_points(camera: Camera, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Some points of a depth map (H, W) in the world (n, 3), and their depths (n,)."""
    depth = np.where(np.isfinite(depth), depth, 0)
    rows, columns = sample_pixels(depth, 2000)
    z = depth[rows, columns].astype(np.float64)
    return (camera.rays_at(rows, columns) * z[:, None]) @ camera.world_to_camera[:3, :3] + camera.center, z


def initial_rotations(cameras: Sequence[Camera], normals: Sequence[np.ndarray], depths: Sequence[np.ndarray],
                      pairs: Sequence[tuple[int, int]]) -> tuple[list[np.ndarray], float]:
    """Rotations (3, 3) of each camera about its centre, in the world, that bring whole photos upon one another, and by
    how many pixels these are offset (median over the pairs; NaN where none of them is alike). `normals` (H, W):
    normalised photos, NaN where masked; `depths` (H, W), scene units; both of the size of `cameras`."""
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
    """Pixels (x, y) from where `own` shows something to where `others` does, by correlation; None: nowhere."""
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


def register_to_mesh(cameras: Sequence[Camera], depths: Sequence[np.ndarray], drawn: Sequence[np.ndarray],
              spread: float) -> Callable[[Camera], Camera]:
    """What moves each camera with the similarity that brings the surface of `depths` (H, W), scene units, nearest to
    the mesh, which is `drawn` through the same cameras. Least squares of the distances from one to the other along the
    mesh's normals, footprints, of every view one mean; cameras are off by `spread` pixels, so that they hold where they
    are what the mesh does not show."""
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
    v, u = sample_pixels(both, _POINTS)
    rays, n, z = camera.rays_at(v, u), central_normals_at(mesh, camera, v, u), both[v, u].astype(np.float64)
    known = np.abs((n * rays).sum(-1)) > _STEEP * np.linalg.norm(rays, axis=-1)
    if not known.any():      # nothing, wires, or all of it seen edge-on
        return None
    v, u, rays, n, z = v[known], u[known], rays[known], n[known] @ turn, z[known]
    c = camera.center - middle
    x = (rays * z[:, None]) @ turn + camera.center - middle
    return (np.c_[np.cross(x, n), n, (n * x).sum(-1)] * (focal / z)[:, None],
            (n * ((mesh[v, u] - z)[:, None] * (rays @ turn))).sum(-1) * focal / z, np.full(len(z), 1 / len(z)),
            np.concatenate([focal * np.c_[np.eye(3), np.zeros((3, 4))],
                            focal / np.median(z) * np.c_[-cross_matrix(c), np.eye(3), c]]))
