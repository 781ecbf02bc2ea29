"""Do photos agree over a surface? Patches of it, looked up in pairs of views and correlated. NumPy alone.

Right cameras see the same texture at the same place of the surface; wrong ones do not. No depth maps, no device and no
ray casting are needed: occlusion is judged by a coarse depth buffer of surface samples.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.random import default_rng

from pagas_cl.scene.camera import Camera
from pagas_cl.scene.images import bilinear
from pagas_cl.scene.mesh import Surface, triangle_normals
from pagas_cl.scene.sampling import evenly

_SIDE = 9            # patch of 9 x 9 samples, one pixel of the reference view apart
_MARGIN = 6.0        # pixels that a patch's middle keeps from the border
_LEAST_SPREAD = 9.0  # pixels, standard deviation of a mesh in an image; patches of a smaller one are of other things
_LEAST_TEXTURE = 3.0  # standard deviation of a patch, grey levels of 255; flatter ones say nothing
_FACING = 0.25       # least cosine between ray and normal
_R2 = np.array([0.7548776662466927, 0.5698402909980532])  # Roberts' low-discrepancy sequence in the plane
LEAST = 30           # patches compared; fewer say nothing
_PER_CELL = 6        # surface samples in a cell of the depth buffer, on average
_PART = 10           # times as many points on all of a surface of which a part is sampled


@dataclass(frozen=True, eq=False)
class Samples:
    """Points spread evenly over a surface, and unit normals, float64 (N, 3).

    The first `few` of them are the middles of patches, all of them fill the depth buffer.
    """

    points: np.ndarray = field(repr=False)
    normals: np.ndarray = field(repr=False)
    few: int = 1500


def area_of(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Area of a mesh (V, 3), (F, 3)."""
    return float(np.cumsum(0.5 * np.linalg.norm(triangle_normals(vertices, faces), axis=1))[-1]) if len(faces) else 0.0


def on_faces(vertices: np.ndarray, faces: np.ndarray, along: np.ndarray, u: np.ndarray, v: np.ndarray,
             alike: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) where shares `along` (N,) of a mesh's area, or, `alike`, of its triangles end, at `u`, `v` (N,) in
    these; unit normals. None where the mesh has no area."""
    across = triangle_normals(vertices, faces)
    twice_area = np.linalg.norm(across, axis=1)
    ends = np.cumsum(twice_area > 0 if alike else twice_area)
    if not len(ends) or not ends[-1] > 0:
        return np.zeros((0, 3)), np.zeros((0, 3))
    face = np.searchsorted(ends, along * ends[-1], side="right").clip(max=len(ends) - 1)
    beyond = u + v > 1      # in the parallelogram's far half: folded back
    u, v = (np.where(beyond, 1 - share, share)[:, None] for share in (u, v))
    a, b, c = (vertices[faces[face, corner]] for corner in range(3))
    return a + u * (b - a) + v * (c - a), across[face] / np.maximum(twice_area[face, None], 1e-300)


def spread_over(vertices: np.ndarray, faces: np.ndarray, number: int) -> tuple[np.ndarray, np.ndarray]:
    """So many points as `on_faces` gives them, evenly over the area, the same ones each time."""
    u, v = np.modf(np.arange(1, number + 1)[:, None] * _R2)[0].T
    return on_faces(vertices, faces, (np.arange(number) + 0.5) / number, u, v)


def sample_surface(surface: Surface, count: int = 20000, few: int = 1500, seen_by: Sequence[Camera] = (),
                   alike: bool = False) -> Samples:
    """`count` points on `surface`, by area or, `alike`, by triangle, that `seen_by` see; the same each time."""
    along, u, v = default_rng(0).random((3, _PART * count if seen_by else count))
    points, normals = on_faces(surface.vertices, surface.faces, along, u, v, alike)
    if seen_by:
        seen = np.logical_or.reduce([camera.holds(*camera.project(points)) for camera in seen_by])
        points, normals = points[seen][:count], normals[seen][:count]
    return Samples(points, normals, min(few, len(points)))


def shares(cameras: Sequence[Camera], points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Shares of the points (N, 3) in front of each camera, and inside its image: two float64 arrays (cameras,)."""
    found = np.empty((2, len(cameras)))
    for k, camera in enumerate(cameras):
        uv, z = camera.project(points)
        found[:, k] = (z > 0).mean(), camera.holds(uv, z).mean()
    return found[0], found[1]


def visible(camera: Camera, samples: Samples) -> np.ndarray:
    """Which of the first `few` samples the camera sees unoccluded and not at a grazing angle: bool (few,)."""
    uv, z = camera.project(samples.points)
    index = np.flatnonzero(camera.holds(uv, z, _MARGIN))
    result, uv, z = np.zeros(samples.few, bool), uv[index], z[index]
    if not len(index) or uv.std(axis=0).max() < _LEAST_SPREAD:
        return result
    cell = max(1.0, np.sqrt(_PER_CELL * camera.size.pixels / len(index)))
    columns = int(camera.width / cell) + 1
    place = (uv[:, 1] / cell).astype(np.intp) * columns + (uv[:, 0] / cell).astype(np.intp)
    nearest = np.full(place.max() + 1, np.inf)
    np.minimum.at(nearest, place, z)
    slack = 3 * cell * z / min(camera.fx, camera.fy)  # a surface that slopes by 70 degrees fills its cell that deep
    ray = samples.points[index] - camera.center
    cosine = np.abs((ray * samples.normals[index]).sum(axis=1)) / np.linalg.norm(ray, axis=1)
    good = (z <= nearest[place] + slack) & (cosine > _FACING)
    result[index[good & (index < samples.few)]] = True
    return result


def overlaps(cameras: list[Camera], samples: Samples, most: int = 12) -> tuple[np.ndarray, list[tuple[int, int]]]:
    """Which samples each view sees, bool (views, few), and pairs of views that share many at a useful angle."""
    points = samples.points[:samples.few]
    seen = np.array([visible(camera, samples) for camera in cameras])
    pairs: list[tuple[int, int]] = []
    for a in evenly(len(cameras), most):
        ranked = []
        for b in range(len(cameras)):
            both = seen[a] & seen[b]
            if a == b or np.count_nonzero(both) < 10:
                continue
            ray_a = points[both] - cameras[a].center
            ray_b = points[both] - cameras[b].center
            lengths = np.linalg.norm(ray_a, axis=1) * np.linalg.norm(ray_b, axis=1)
            cosine = (ray_a * ray_b).sum(axis=1) / lengths
            angle = np.degrees(np.arccos(np.clip(np.median(cosine), -1, 1)))
            if 2 < angle < 45:
                ranked.append((np.count_nonzero(both), int(b)))
        pairs += [(int(a), b) for _, b in sorted(ranked, reverse=True)[:2]]
    return seen, pairs[:2 * most]


def from_middle(cameras: Sequence[Camera]) -> np.ndarray:
    """Places of cameras, one or more, from the middle one outwards."""
    centers = np.array([camera.center for camera in cameras])
    middle = centers[np.argmin(np.linalg.norm(centers - np.median(centers, axis=0), axis=1))]
    return np.argsort(np.linalg.norm(centers - middle, axis=1), kind="stable")


def groups(cameras: Sequence[Camera], most: int) -> Iterator[np.ndarray]:
    """Places of up to `most` cameras, in order, evenly chosen: of all, then of ever fewer around the middle one."""
    yield evenly(len(cameras), most)
    near = from_middle(cameras)
    while len(near) > most:
        near = near[:max(most, len(near) // 4)]
        yield np.sort(near[evenly(len(near), most)])


def patch_correlation(cameras: list[Camera], greys: list[np.ndarray], pairs: list[tuple[int, int]], seen: np.ndarray,
                      samples: Samples) -> np.ndarray:
    """Zero-mean normalised correlation of each patch between the reference view and the other view of each pair.

    `greys`: (H, W) float32 of 255; `seen`: bool (views, few). Gives (pairs, few), NaN where unseen or without texture.
    """
    points, normals = samples.points[:samples.few], samples.normals[:samples.few]
    result = np.full((len(pairs), samples.few), np.nan)
    for row, (a, b) in enumerate(pairs):
        index = np.flatnonzero(seen[a] & seen[b])
        if len(index):
            patch = patch_grids(points[index], normals[index], cameras[a])
            result[row, index] = correlation(look_up(greys[a], cameras[a], patch), look_up(greys[b], cameras[b], patch))
    return result


def patch_grids(points: np.ndarray, normals: np.ndarray, camera: Camera) -> np.ndarray:
    """Grids on the tangent planes, one pixel of `camera` apart: (n, _SIDE**2, 3)."""
    right = np.broadcast_to(camera.world_to_camera[0, :3], normals.shape)
    down = np.cross(normals, right)
    down /= np.maximum(np.linalg.norm(down, axis=1, keepdims=True), 1e-12)
    right = np.cross(down, normals)
    footprint = (camera.project(points)[1] / np.sqrt(camera.fx * camera.fy))[:, None, None]
    steps = np.arange(_SIDE) - (_SIDE - 1) / 2
    u, v = (grid.ravel()[None, :, None] for grid in np.meshgrid(steps, steps))
    return np.asarray(points[:, None] + footprint * (u * right[:, None] + v * down[:, None]))


def correlation(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Zero-mean normalised correlation of the rows of two arrays (N, M); NaN where one has too little texture."""
    a = a - a.mean(axis=1, keepdims=True)
    b = b - b.mean(axis=1, keepdims=True)
    deviation_a = np.sqrt((a * a).mean(axis=1))
    deviation_b = np.sqrt((b * b).mean(axis=1))
    with np.errstate(divide="ignore", invalid="ignore"):
        value = (a * b).mean(axis=1) / (deviation_a * deviation_b)
    return np.where((deviation_a > _LEAST_TEXTURE) & (deviation_b > 0.3 * _LEAST_TEXTURE), value, np.nan)


def look_up(grey: np.ndarray, camera: Camera, points: np.ndarray) -> np.ndarray:
    """Grey levels (...) of an image where its camera sees points (..., 3)."""
    uv, _ = camera.project(points)
    return bilinear(grey, uv[..., 0], uv[..., 1])


def grey_of(image: np.ndarray) -> np.ndarray:
    """uint8 RGB (H, W, 3) as grey levels, float32 (H, W), Rec. 601 luma."""
    return image.astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)


def prefers(other: np.ndarray, given: np.ndarray) -> bool:
    """Whether patches correlate significantly better under another reading."""
    # neighbours are related: only a quarter of them is counted as independent
    gain = (other - given)[np.isfinite(other) & np.isfinite(given)]
    return bool(len(gain) >= LEAST and (gain > 0).mean() > 0.5 + 1.5 / np.sqrt(len(gain) / 4)
                and np.median(gain) > 2e-3)
