"""Keep my mesh: move its vertices onto refined depths that several views agree on; what views say of vertices.

Topology, and with it texture coordinates and whatever else sits on the mesh, stays. Each vertex moves along its normal
by what the refined depth maps say against the initial ones, so that the mesh's own deviation from its depth maps
(facets, rounding) cancels.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, replace

import numpy as np

from pagas_cl.scene.camera import Camera
from pagas_cl.scene.depthmap import resize_depth
from pagas_cl.scene.mesh import Surface

log = logging.getLogger("pagas_cl")

_FACING = 0.2    # least cosine between ray and normal
_NEAR = 3.0      # a vertex is seen where its depth is within this many footprints of the initial depth map
_ON_MAP = 30.0   # footprints between a vertex and a depth map that it is said to lie on
_STEPS = 3       # Newton steps along the normal; one is exact on a plane


@dataclass(frozen=True, eq=False)
class Displacement:
    """Where the vertices go, (V, 3) float64; which have moved (V,), the others having too few views that agree, or a
    triangle that would turn over; views that agree (V,); mean confidence of those (V,), 0 where the vertex stayed."""

    vertices: np.ndarray = field(repr=False)
    moved: np.ndarray = field(repr=False)
    agreeing: np.ndarray = field(repr=False)
    quality: np.ndarray = field(repr=False)


@dataclass(frozen=True, eq=False)
class Observed:
    """A view's initial and refined depth, and how far to trust the latter; arrays (H, W), 0 = no surface."""

    camera: Camera
    initial: np.ndarray = field(repr=False)
    refined: np.ndarray = field(repr=False)
    parallax: np.ndarray = field(repr=False)    # depth that moves a pixel by one pixel in the context views
    confidence: np.ndarray = field(repr=False)  # 0 to 1


def displace(surface: Surface, views: list[Observed], *, agree_views: int = 1,
             agree_pixels: float = 2.0) -> Displacement:
    """Move the vertices of `surface`, each only if at least `agree_views` (at least 1) others confirm the view that
    speaks for it: their moves differ by no more than `agree_pixels` pixels of parallax."""
    points, welded = np.unique(surface.vertices, axis=0, return_inverse=True)
    welded, agree_views = welded.reshape(-1), max(1, agree_views)
    faces, middle = welded[surface.faces], points.mean(axis=0)
    local, normals, edge = points - middle, _normals(points, faces), _edge_length(points, faces)
    said = np.zeros((4, len(views), len(points)))
    for row, view in enumerate(views):
        pose = view.camera.world_to_camera.copy()  # around `middle`: keeps the digits far from the origin
        pose[:3, 3] = pose[:3, :3] @ (middle - view.camera.center)
        seen, *of_view = _moves(local, normals, replace(view.camera, world_to_camera=pose), view, edge)
        said[:, row, seen] = of_view
    along, agreeing, quality = _agreed(*said, agree_views, agree_pixels)
    along = _without_turning(local, normals, along, faces)
    moved = along != 0
    log.info("displacement: %d of %d vertices moved, %d stayed (fewer than %d views agreed, or a triangle would have "
             "turned over)", moved[welded].sum(), len(welded), (~moved[welded]).sum(), agree_views + 1)
    new = np.where(moved[:, None], points + along[:, None] * normals, points)
    return Displacement(new[welded], moved[welded], agreeing[welded], np.where(moved, quality, 0)[welded])


def _normals(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals of vertices, weighted by area; zero where the faces around have no area."""
    local = points - points.mean(axis=0)
    a, b, c = (local[faces[:, k]] for k in range(3))
    across, normals = np.cross(b - a, c - a), np.zeros_like(points)
    for k in range(3):
        np.add.at(normals, faces[:, k], across)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)


def _edge_length(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Mean length of the edges around each vertex."""
    total, count = np.zeros(len(points)), np.zeros(len(points))
    for i, j in ((0, 1), (1, 2), (2, 0)):
        length = np.linalg.norm(points[faces[:, i]] - points[faces[:, j]], axis=1)
        for k in (i, j):
            np.add.at(total, faces[:, k], length)
            np.add.at(count, faces[:, k], 1)
    return total / np.maximum(count, 1)


def _moves(points, normals, camera: Camera, view: Observed, edge):
    """Seen points; their move along the normal, its weight (0: no word), one pixel of parallax along it, confidence."""
    uv, z = camera.project(points)
    ray = points - camera.center
    size = np.abs(z) / np.sqrt(camera.fx * camera.fy)
    with np.errstate(divide="ignore", invalid="ignore"):
        cosine = (ray * normals).sum(axis=1) / np.linalg.norm(ray, axis=1)
        seen = (z > 0) & (np.abs(cosine) > _FACING) & (uv > 0.5).all(axis=1)
        seen &= (uv < np.array([camera.width, camera.height]) - 0.5).all(axis=1)
    index = np.flatnonzero(seen)
    before, good = _look_up(view.initial, uv[index], None)
    good &= np.abs(before - z[index]) < _NEAR * size[index] / np.abs(cosine[index])
    index, before = index[good], before[good]
    # a vertex stands for the area around it, so many pixels wide, and not for one pixel
    cells = max(1, int(np.median(edge[index] / size[index]) / 2)) if len(index) else 1
    camera, initial, refined = _shrunk(camera, view, cells)
    jump = 2 * _NEAR * cells * size[index] / np.abs(cosine[index])
    slope = ((points[index] - camera.center) * normals[index]).sum(axis=1) / z[index]  # move along n per unit of depth
    start, good = _look_up(initial, camera.project(points[index])[0], jump)
    bias = start - z[index]
    move = np.zeros(len(index))
    for _ in range(_STEPS):
        at, depth = camera.project(points[index] + move[:, None] * normals[index])
        after, valid = _look_up(refined, at, jump)
        good &= valid
        move = move + np.where(good, (after - depth - bias) * slope, 0)
    index, move, slope, at = index[good], move[good], slope[good], uv[index][good]
    place = at.astype(np.intp)
    confidence = view.confidence[place[:, 1], place[:, 0]]
    parallax = view.parallax[place[:, 1], place[:, 0]] * np.abs(slope)
    weight = confidence * np.square(cosine[index] / size[index])
    return index, move, np.where(parallax > 0, weight, 0), parallax, confidence


def _shrunk(camera: Camera, view: Observed, cells: int):
    """Camera and depth maps at 1 / `cells` of the size, averaging valid depths; only where both maps are valid."""
    both = (view.initial > 0) & (view.refined > 0)
    initial, refined = np.where(both, view.initial, 0), np.where(both, view.refined, 0)
    width, height = max(2, camera.width // cells), max(2, camera.height // cells)
    if cells == 1 or width < 8 or height < 8:
        return camera, initial.astype(np.float32), refined.astype(np.float32)
    return (camera.resized(width, height), resize_depth(initial, width, height), resize_depth(refined, width, height))


def _look_up(depth: np.ndarray, uv: np.ndarray, jump) -> tuple[np.ndarray, np.ndarray]:
    """Depths at image positions (n, 2), interpolated as inverse depth, and where all four neighbours are valid and
    differ by less than `jump`."""
    height, width = depth.shape
    x, y = np.clip(uv[:, 0] - 0.5, 0, width - 1), np.clip(uv[:, 1] - 0.5, 0, height - 1)
    left, top = np.minimum(x.astype(np.intp), width - 2), np.minimum(y.astype(np.intp), height - 2)
    fx, fy = x - left, y - top
    corners = np.stack([depth[top + r, left + c] for r in (0, 1) for c in (0, 1)]).astype(np.float64)
    share = np.stack([(1 - fy) * (1 - fx), (1 - fy) * fx, fy * (1 - fx), fy * fx])
    good = (corners > 0).all(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        value = np.where(good, 1 / (share / corners).sum(axis=0), 0)
    if jump is not None:
        good &= np.ptp(corners, axis=0) < jump
    return value, good


def _agreed(moves, trust, depth_per_parallax, sure, agree_views: int, agree_pixels: float):
    """Weighted mean of the moves near their median, where enough views are: (move, views, mean confidence)."""
    said, count = trust > 0, moves.shape[1]
    along, agreeing, quality = np.zeros(count), np.zeros(count, np.int64), np.zeros(count)
    index = np.flatnonzero(said.sum(axis=0) > agree_views)
    if not len(index):
        return along, agreeing, quality
    part, said = moves[:, index], said[:, index]
    middle = np.nanmedian(np.where(said, part, np.nan), axis=0)
    near = said & (np.abs(part - middle) <= agree_pixels * depth_per_parallax[:, index])
    count = near.sum(axis=0)
    enough = count > agree_views
    weight = np.where(near, trust[:, index], 0)
    total = np.where(enough, weight.sum(axis=0), 1)
    along[index] = np.where(enough, (weight * part).sum(axis=0) / total, 0)
    agreeing[index] = count
    quality[index] = np.where(enough, (near * sure[:, index]).sum(axis=0) / np.maximum(count, 1), 0)
    return along, agreeing, quality


def _without_turning(points, normals, along, faces) -> np.ndarray:
    """The moves, less those of the corners of triangles that would turn over."""
    a, b, c = (points[faces[:, k]] for k in range(3))
    before = np.cross(b - a, c - a)
    along = along.copy()
    for _ in range(10):
        a, b, c = (points[faces[:, k]] + along[faces[:, k], None] * normals[faces[:, k]] for k in range(3))
        turned = (np.cross(b - a, c - a) * before).sum(axis=1) < 0
        turned &= (along[faces] != 0).any(axis=1)
        if not turned.any():
            break
        along[np.unique(faces[turned])] = 0
    return along


def footprints(vertices: np.ndarray, cameras: list[Camera], depths: list[np.ndarray]) -> np.ndarray:
    """Size of a pixel at each vertex in the view that sees it finest, scene units; infinite where no view does."""
    finest = np.full(len(vertices), np.inf)
    for camera, depth in zip(cameras, depths):
        index, _, size = _seen(vertices, camera, depth)
        finest[index] = np.minimum(finest[index], size)
    return finest


def vertex_confidence(vertices: np.ndarray, results) -> np.ndarray:
    """Mean confidence (0 to 1) of the DepthResults that see each vertex, float64 of shape (V,); 0 where none does."""
    total, count = np.zeros(len(vertices)), np.zeros(len(vertices))
    for result in results:
        index, place, _ = _seen(vertices, result.camera, result.depth)
        total[index] += result.confidence[place]
        count[index] += 1
    return total / np.maximum(count, 1)


def _seen(vertices: np.ndarray, camera: Camera, depth: np.ndarray):
    """Indices of the vertices that lie on the depth map; rows and columns there; the size of a pixel at each."""
    uv, z = camera.project(vertices)
    with np.errstate(invalid="ignore"):
        inside = (z > 0) & (uv >= 0).all(axis=1) & (uv < (camera.width, camera.height)).all(axis=1)
    index = np.flatnonzero(inside)
    columns, rows = uv[index].astype(np.intp).T
    size, found = z[index] / np.sqrt(camera.fx * camera.fy), depth[rows, columns]
    near = (found > 0) & (np.abs(found - z[index]) < _ON_MAP * size)
    return index[near], (rows[near], columns[near]), size[near]
