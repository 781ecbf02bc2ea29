"""Synthetic scenes with true surfaces, for measuring meshes: a relief, wires in front of a wall, a closed object seen
all round, a thin sheet seen from both sides, a box with sharp creases. Photos are cast rays under a solid texture.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from scipy import ndimage
from support import synthetic
from support.synthetic.mesh import solid_mesh

from pagas_cl.scene.camera import Camera

FOCAL = 1.8        # over the image's width
SUN = np.array([0.35, -0.45, -0.82]) / np.linalg.norm([0.35, -0.45, -0.82])


@dataclass
class Scene:
    """True and given mesh as (vertices, faces); one footprint is a unit: a pixel is that wide on the surface."""

    name: str
    cameras: list[Camera]
    photos: list[np.ndarray]
    true: tuple[np.ndarray, np.ndarray]
    given: tuple[np.ndarray, np.ndarray]


def relief(width: int = 320, seed: int = 0) -> Scene:
    made = synthetic.relief_scene(width, width * 3 // 4, contexts=6, held_out=0, detail=0.3, seed=seed)
    unit = made.relief.footprint
    half = synthetic.layout.half_sizes(made.relief)
    true, given = (_scaled(solid_mesh(solid, spacing * unit, half), 1 / unit) for solid, spacing in
                   ((made.true_solid, 0.5), (made.initial_solid, 4.0)))
    cameras = []
    for camera in made.cameras:
        pose = camera.world_to_camera.copy()
        pose[:3, 3] /= unit
        cameras.append(Camera(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, pose,
                              camera.name))
    return Scene("relief", cameras, [view.image for view in made.views], true, given)


def relief_1(width: int = 320) -> Scene:
    """Another shape, another error of the given mesh, other texture."""
    return relief(width, 1)


def relief_2(width: int = 320) -> Scene:
    return relief(width, 2)


def wires(width: int = 320) -> Scene:
    rng = np.random.default_rng(1)
    large, fine = _waves(rng, 60, 300, 4.0), _waves(rng, 6, 40, 0.8)
    error = _waves(rng, 40, 200, 1.2)
    side = 0.75 * width
    wall = [_height(step, side, field) for step, field in
            ((0.5, lambda x, y: large(x, y) + fine(x, y)), (4.0, lambda x, y: large(x, y) + error(x, y)))]
    true, given = [wall[0]], [wall[1]]
    for x, y, z, lean, radius in ((-60, 0, -30, 0.3, 2.0), (10, 0, -45, -0.2, 1.5), (70, 0, -20, 0.05, 4.0)):
        axis = np.array([lean, 1, 0.1 * lean])
        true.append(_tube((x, y, z), axis, radius, side, 48, 1.0))
        given.append(_tube((x + 0.2, y, z + 1.2), axis, radius * 1.1, side, 10, 4.0))
    return _photographed("wires", _grid_of_cameras(width, 7), _joined(true), _joined(given))


def closed(width: int = 256) -> Scene:
    rng = np.random.default_rng(2)
    large, fine, error = _waves(rng, 60, 200, 5.0, 3), _waves(rng, 8, 40, 0.7, 3), _waves(rng, 40, 160, 1.2, 3)
    true, given = (_ball(0.3 * width, step, field) for step, field in
                   ((0.8, lambda *p: large(*p) + fine(*p)), (5.0, lambda *p: large(*p) + error(*p))))
    cameras = [_look_from(FOCAL * width, turn, up, width, f"{turn}_{up}") for up in (-25, 25)
               for turn in range(0, 360, 24)]
    return _photographed("closed", cameras, true, given)


def sheet(width: int = 256) -> Scene:
    rng = np.random.default_rng(3)
    large, fine, error = _waves(rng, 80, 300, 6.0), _waves(rng, 8, 40, 0.6), _waves(rng, 40, 200, 0.8)
    true, given = (_thick(0.28 * width, step, field, 3.0) for step, field in
                   ((0.5, lambda x, y: large(x, y) + fine(x, y)), (4.0, lambda x, y: large(x, y) + error(x, y))))
    cameras = [_look_from(FOCAL * width, back + turn, up, width, f"{back}_{turn}_{up}") for back in (0, 180)
               for turn, up in ((0, 0), (15, 4), (-15, -4), (5, 14), (-5, -14))]
    return _photographed("sheet", cameras, true, given)


def box(width: int = 256) -> Scene:
    rng = np.random.default_rng(4)
    error = _waves(rng, 40, 200, 1.0, 3)
    half = 0.2 * width
    blocks = [((0, 0, 0), (half,) * 3), ((0.3 * half, -0.2 * half, -half), (0.4 * half, 0.5 * half, 0.25 * half))]
    true = _joined([_cuboid(*block, 0.6) for block in blocks])
    given = _joined([_cuboid(*block, 4.0) for block in blocks])
    given = given[0] + error(*given[0].T)[:, None] * _outward(*given), given[1]
    cameras = [_look_from(FOCAL * width, turn, up, width, f"{turn}_{up}") for turn, up in
               ((0, 0), (12, 4), (-12, -4), (4, -14), (-4, 14), (25, 18), (-25, 18), (20, -22), (-20, -22))]
    return _photographed("box", cameras, true, given)


def _scaled(mesh, factor):
    return mesh[0] * factor, mesh[1]


def _waves(rng, shortest, longest, size, dimensions=2):
    """A sum of plane waves of wavelengths shortest to longest, root mean square `size`."""
    length = np.exp(rng.uniform(np.log(shortest), np.log(longest), 14))
    directions = rng.normal(size=(14, dimensions))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True) * length[:, None]
    weight = (length / longest) ** 0.7
    weight *= size / np.sqrt(0.5 * (weight**2).sum())
    phase = rng.uniform(0, 1, 14)

    def field(*place):
        return sum(w * np.sin(2 * np.pi * (sum(t * p for t, p in zip(turn, place)) + f))
                   for w, turn, f in zip(weight, directions, phase))
    return field


def _sheet_faces(rows, columns):
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]))
    return np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)])


def _height(step, half, field):
    number = int(np.ceil(2 * half / step)) + 1
    x, y = (part.ravel() for part in np.meshgrid(*2 * [np.linspace(-half, half, number)]))
    return np.stack([x, y, field(x, y)], 1), _sheet_faces(number, number)


def _tube(point, axis, radius, half, sides, step):
    axis = np.asarray(axis, float) / np.linalg.norm(axis)
    across = np.cross(axis, (0, 0, 1.0))
    across /= np.linalg.norm(across)
    turn = -2 * np.pi * np.arange(sides) / sides
    ring = radius * (np.cos(turn)[:, None] * across + np.sin(turn)[:, None] * np.cross(axis, across))
    rings = int(np.ceil(2 * half / step)) + 1
    along = np.linspace(-half, half, rings)
    vertices = (np.asarray(point) + along[:, None, None] * axis + ring).reshape(-1, 3)
    faces = _sheet_faces(rings, sides + 1)
    row, column = np.divmod(faces, sides + 1)
    return vertices, row * sides + column % sides


def _sphere(number):
    """Unit cube's faces, each a grid, on the sphere: vertices welded."""
    parts = [_cube_face(axis, sign, number) for axis in range(3) for sign in (-1, 1)]
    return _welded(*_joined(parts))


def _cube_face(axis, sign, number):
    place = np.linspace(-1, 1, number + 1)
    u, v = (part.ravel() for part in np.meshgrid(place, place))
    points = np.empty((len(u), 3))
    points[:, axis], points[:, (axis + 1) % 3], points[:, (axis + 2) % 3] = sign, u, v
    faces = _sheet_faces(number + 1, number + 1)
    return points, faces[:, ::-1] if sign > 0 else faces


def _welded(vertices, faces):
    _, first, new = np.unique(np.rint(vertices * 1e6).astype(np.int64), axis=0, return_index=True, return_inverse=True)
    return vertices[first], new.reshape(-1)[faces]


def _ball(radius, step, field):
    points, faces = _sphere(int(np.ceil(1.6 * radius / step)))
    points = np.tan(points * np.pi / 4)
    points *= radius / np.linalg.norm(points, axis=1, keepdims=True)
    return points * (1 + field(*points.T) / radius)[:, None], faces


def _cuboid(middle, half, step):
    parts = []
    for axis in range(3):
        number = [int(np.ceil(2 * h / step)) for h in half]
        for sign in (-1, 1):
            j, k = (axis + 1) % 3, (axis + 2) % 3
            u, v = (part.ravel() for part in np.meshgrid(np.linspace(-half[j], half[j], number[j] + 1),
                                                         np.linspace(-half[k], half[k], number[k] + 1)))
            points = np.empty((len(u), 3))
            points[:, axis], points[:, j], points[:, k] = sign * half[axis], u, v
            faces = _sheet_faces(number[k] + 1, number[j] + 1)
            parts.append((points + middle, faces[:, ::-1] if sign > 0 else faces))
    return _welded(*_joined(parts))


def _thick(radius, step, field, thickness):
    """A disc with two sides, `thickness` apart, closed along its rim."""
    number = int(np.ceil(2 * radius / step)) + 1
    u, v = (part.ravel() for part in np.meshgrid(*2 * [np.linspace(-1, 1, number)]))
    x, y = radius * u * np.sqrt(1 - v**2 / 2), radius * v * np.sqrt(1 - u**2 / 2)
    z, faces = field(x, y), _sheet_faces(number, number)
    index = np.arange(number**2).reshape(number, number)
    rim = np.concatenate([index[0, :-1], index[:-1, -1], index[-1, :0:-1], index[:0:-1, 0]])
    far, ahead = rim + number**2, np.roll(rim, -1)
    band = np.concatenate([np.stack([rim, ahead, far], 1), np.stack([ahead, ahead + number**2, far], 1)])
    vertices = np.concatenate([np.stack([x, y, z - thickness / 2], 1), np.stack([x, y, z + thickness / 2], 1)])
    return vertices, np.concatenate([faces, faces[:, ::-1] + number**2, band])


def _outward(vertices, faces):
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normal = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(normal, faces[:, k], np.cross(b - a, c - a))
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)


def _joined(parts):
    first = np.cumsum([0, *(len(v) for v, _ in parts)])
    return np.concatenate([v for v, _ in parts]), np.concatenate([f + n for (_, f), n in zip(parts, first)])


def _look_from(distance, turn, up, width, name) -> Camera:
    """A camera `turn` and `up` degrees around the origin from the -z side."""
    turn, up = np.radians([turn, up])
    away = np.array([np.sin(turn) * np.cos(up), np.sin(up), -np.cos(turn) * np.cos(up)])
    x = np.cross([0.0, 1.0, 0.0], -away)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = [x, np.cross(-away, x), -away]
    pose[:3, 3] = -pose[:3, :3] @ (away * distance)
    height = width * 3 // 4
    return Camera(width, height, FOCAL * width, FOCAL * width, 0.503 * width, 0.494 * height, pose, name)


def _grid_of_cameras(width, number):
    places = ((0, 0), (11, 0), (-11, 0), (0, 11), (0, -11), (11, 11), (-11, -11), (11, -11), (-11, 11))
    return [_look_from(FOCAL * width, *place, width, f"view{k}") for k, place in enumerate(places[:number])]


def _photographed(name, cameras, true, given, samples=2) -> Scene:
    import open3d as o3d

    rng = np.random.default_rng(7)
    octaves = [(period, rng.normal(size=(32, 32, 32, 3)).astype(np.float32)) for period in (2.5, 6, 15, 40)]
    scene, tensor = o3d.t.geometry.RaycastingScene(), o3d.core.Tensor
    scene.add_triangles(tensor(true[0].astype(np.float32)), tensor(true[1].astype(np.uint32)))
    photos = []
    for camera in cameras:
        total = np.zeros((camera.height, camera.width, 3), np.float32)
        for k in range(samples**2):
            v, u = (np.array(divmod(k, samples)) + 0.5) / samples - 0.5
            pixels = camera.rays() + (u / camera.fx, v / camera.fy, 0)
            rays = np.empty((*pixels.shape[:2], 6), np.float32)
            rays[..., :3], rays[..., 3:] = camera.center, pixels @ camera.world_to_camera[:3, :3]
            hit = scene.cast_rays(tensor(rays))
            depth, normal = hit["t_hit"].numpy(), hit["primitive_normals"].numpy()
            found = np.isfinite(depth)
            places = (rays[..., :3] + np.where(found, depth, 0)[..., None] * rays[..., 3:])[found]
            light = 0.75 + 0.25 * np.maximum(normal[found] @ SUN, 0)
            total[found] += (_texture(places, octaves) * light[:, None]) / samples**2
        photos.append(np.rint(np.clip(total, 0, 1) * 255).astype(np.uint8))
    return Scene(name, cameras, photos, true, given)


def _texture(places, octaves):
    out = np.full((len(places), 3), 0.5, np.float32)
    for period, lattice in octaves:
        at = (places.T / period + 16).astype(np.float32)
        for channel in range(3):
            out[:, channel] += 0.11 * ndimage.map_coordinates(lattice[..., channel], at, order=1, mode="grid-wrap")
    return out
