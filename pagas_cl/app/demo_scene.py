"""A small scene whose true depth is known: a relief under photographs, made as a mesh and drawn from a few places.

The photos show the fine mesh, lit and coloured, and its depth is the truth; the refinement starts from a coarse one.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pagas_cl.errors import InputError, need
from pagas_cl.method.surface.raster import each_depth
from pagas_cl.result import normals_of
from pagas_cl.scene.camera import Camera, rigid
from pagas_cl.scene.depthmap import save_depth
from pagas_cl.scene.images import bilinear, write_image
from pagas_cl.scene.mesh import Surface, grid_faces
from pagas_cl.scene.meshes.files import write_mesh
from pagas_cl.scene.meshes.kinds import from_surface, to_surface
from pagas_cl.scene.readers import camera_file
from pagas_cl.scene.view import View

# where context views stand around the target, in steps between neighbours (right, down); the held-out view after them
_GRID = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1), (1, -1), (-1, 1), (2, 0), (-2, 0), (0, 2), (0, -2),
         (2, 1), (-2, -1), (1, -2), (-1, 2))
_HELD_OUT = (0.6, -0.75)
_FOCAL, _DISTANCE, _WIDE = 1.86, 650.0, 300.0    # focal length over width; of the cameras; width of the object
_PLANE = 0.75             # half of what views may see, shares of the photo
_SAMPLES = 3              # along each side of a pixel of a photo
_SPACING = np.radians(11.0)     # between neighbouring views
_COARSE = 4.0             # pixels between vertices of the coarse mesh
_BLOCKS = ((-0.24, 0.17, 0.11, 0.13, 14.0), (0.26, -0.2, 0.09, 0.1, 25.0), (0.2, 0.25, 0.05, 0.05, 8.0),
           (-0.28, -0.28, 0.03, 0.12, 18.0))       # middle and half sizes, shares of the photo; height
_BAR_DEPTH, _BAR_SIDES = 70.0, 24                  # how far a bar is in front of the relief; of its round
_SMOOTHINGS = 30          # Taubin's, of a mesh whose vertices were clustered
_SUN = np.array([0.35, -0.45, -0.82])
_SHADING = 0.3            # share of the light that falls off with the angle to the sun


@dataclass(frozen=True)
class Look:
    """Root mean square of the coarse shape, scene units; mean absolute height of the fine detail, pixels of parallax;
    how many blocks; width of a bar in front, pixels."""

    base: float = 9.0
    detail: float = 0.25
    blocks: int = 2
    bar: float = 0.0


FAR = Look(8.0, 0.3, 4, 4.0)
"""Of a scene whose coarse mesh is far off."""
CLUSTERED = 3.33
"""Pixels of parallax within which vertices of the true mesh become one, of a coarse mesh that is far off."""


@dataclass(frozen=True, eq=False)
class DemoScene:
    """`views`: the target, its context views, and last a held-out one; depth maps (H, W) float32 of each, 0 = no
    surface; `parallax`: depth of one pixel of parallax, scene units."""

    views: list[View]
    true: list[np.ndarray]
    initial: list[np.ndarray]
    coarse: Surface
    parallax: float

    def write(self, folder: Path) -> Path:
        """Write images, cameras.json, mesh_coarse.ply, depth_initial and depth_true: input for the other commands."""
        for name in ("images", "depth_initial", "depth_true"):
            (folder / name).mkdir(parents=True, exist_ok=True)
        for view, initial, true in zip(self.views, self.initial, self.true):
            write_image(folder / "images" / f"{view.name}.png", view.load_image())
            save_depth(folder / "depth_initial" / f"{view.name}.npz", initial)
            save_depth(folder / "depth_true" / f"{view.name}.npz", true)
        camera_file.write(folder, [replace(view, name=f"{view.name}.png") for view in self.views])
        write_mesh(folder / "mesh_coarse.ply", self.coarse)
        return folder


def make_scene(width: int, height: int, contexts: int, device, look: Look | None = None,
               clustered: float = 0.0) -> DemoScene:
    """The scene, drawn on `device`. `clustered`: where positive, the coarse mesh is the true one, vertices within so
    many pixels of parallax drawn together and smoothed: thin things are gone and edges rounded (needs Open3D)."""
    if not (16 <= width <= 1 << 15 and 16 <= height <= 1 << 15):
        raise InputError(f"demo scene: photos of {width} x {height}, expected sides of 16 to {1 << 15} pixels")
    if not 1 <= contexts <= len(_GRID):
        raise InputError(f"demo scene: {contexts} context views, expected 1 to {len(_GRID)}")
    look, pixel = look or Look(), _DISTANCE / (_FOCAL * width)
    parallax = pixel / np.sin(_SPACING)
    rng = np.random.default_rng(0)
    base = _waves(rng, 6, 0.4 * _WIDE, 1.2 * _WIDE, look.base)
    detail = _waves(rng, 28, 5 * pixel, 40 * pixel, 1.25 * look.detail * parallax)
    size = width * pixel, height * pixel
    fine = _with_bar(_relief(lambda x, y: base(x, y) + detail(x, y), size, pixel, look), look.bar * pixel)
    if clustered:
        coarse = _clustered(fine, clustered * parallax)
    else:
        coarse = _with_bar(_relief(base, size, _COARSE * pixel, look), look.bar * pixel, look.detail * parallax)
    places = [("target", (0, 0)), *((f"context_{k:02d}", place) for k, place in enumerate(_GRID[:contexts])),
              ("held_out", _HELD_OUT)]
    cameras = [_camera(name, width, height, _SPACING * np.array(place)) for name, place in places]
    texture = _noise(rng, *(int(np.ceil(2 * _PLANE * side / pixel)) for side in size))
    drawn = each_depth(fine, [camera.resized(_SAMPLES * width, _SAMPLES * height) for camera in cameras], device)
    views = [View(camera, _photo(camera, depth, texture, pixel), None, camera.name)
             for camera, depth in zip(cameras, drawn)]
    return DemoScene(views, list(each_depth(fine, cameras, device)), list(each_depth(coarse, cameras, device)), coarse,
                     float(parallax))


def _camera(name: str, width: int, height: int, angles: np.ndarray) -> Camera:
    """A camera that looks at the relief's middle, so many radians to the right of the front and down from it."""
    (c, cu), (s, su) = np.cos(angles), np.sin(angles)
    away = np.array([s * cu, su, -c * cu])  # from the object to the camera
    x = np.cross([0.0, 1.0, 0.0], -away)
    x /= np.linalg.norm(x)
    pose = rigid([x, np.cross(-away, x), -away], [0, 0, _DISTANCE])
    # a principal point off the middle, as real cameras have
    return Camera(width, height, _FOCAL * width, _FOCAL * width, 0.503 * width, 0.494 * height, pose, name)


def _waves(rng, number: int, shortest: float, longest: float, size: float):
    """A height field: plane waves of these lengths, longer ones higher, root mean square `size`."""
    length = np.exp(rng.uniform(np.log(shortest), np.log(longest), number))
    angle = rng.uniform(0, 2 * np.pi, number)
    height = length**2 * size / np.sqrt(0.5 * (length**4).sum())
    phase = rng.uniform(0, 2 * np.pi, number)

    def field(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        total = np.zeros_like(x)
        for h, long, turn, start in zip(height, length, angle, phase):
            total += h * np.sin(2 * np.pi / long * (x * np.cos(turn) + y * np.sin(turn)) + start)
        return total

    return field


def _relief(field, size: tuple[float, float], spacing: float, look: Look) -> Surface:
    """The relief with its blocks, a vertex each `spacing`, facing the viewers (-z)."""
    halves = [_PLANE * side for side in size]
    across, down = (int(np.ceil(2 * half / spacing)) + 1 for half in halves)
    x, y = (grid.ravel() for grid in np.meshgrid(np.linspace(-halves[0], halves[0], across),
                                                 np.linspace(-halves[1], halves[1], down)))
    z = field(x, y)
    for middle_x, middle_y, half_x, half_y, rise in _BLOCKS[:look.blocks]:
        on = (np.abs(x / size[0] - middle_x) < half_x) & (np.abs(y / size[1] - middle_y) < half_y)
        z -= rise * on
    return Surface(np.stack([x, y, z], axis=1), grid_faces(across, down))


def _with_bar(surface: Surface, width: float, nearer: float = 0.0) -> Surface:
    """The mesh with a round bar in front of it, as wide as so many scene units at the relief and by so much too near,
    where it covers the same pixels of the target."""
    if not width:
        return surface
    axis = np.array([0.35, 1.0, 0.12]) / np.linalg.norm([0.35, 1.0, 0.12])
    side = np.cross(axis, [0.0, 0.0, 1.0]) / np.linalg.norm(np.cross(axis, [0.0, 0.0, 1.0]))
    turn = 2 * np.pi * np.arange(_BAR_SIDES)[:, None] / _BAR_SIDES
    ring = 0.5 * width * (1 - _BAR_DEPTH / _DISTANCE) * (np.cos(turn) * side + np.sin(turn) * np.cross(axis, side))
    middle = np.array([0.05 * _WIDE, 0.0, -_BAR_DEPTH])
    bar = np.concatenate([middle + sign * 2 * _WIDE * axis + ring for sign in (-1, 1)])
    eye = np.array([0.0, 0.0, -_DISTANCE])
    bar = eye + (1 - nearer / _DISTANCE) * (bar - eye)
    near = np.arange(_BAR_SIDES)
    other = np.roll(near, -1)
    band = np.concatenate([np.stack([near, other, near + _BAR_SIDES], axis=1),
                           np.stack([other, other + _BAR_SIDES, near + _BAR_SIDES], axis=1)])
    return Surface(np.concatenate([surface.vertices, bar]),
                   np.concatenate([surface.faces, band + len(surface.vertices)]))


def _clustered(surface: Surface, size: float) -> Surface:
    """Vertices within `size` drawn together, and smoothed."""
    o3d = need("open3d", "mesh", "a coarse mesh that is far off")
    mesh = from_surface(surface, like=o3d.geometry.TriangleMesh())
    mesh = mesh.simplify_vertex_clustering(size, o3d.geometry.SimplificationContraction.Average)
    mesh = mesh.filter_smooth_taubin(_SMOOTHINGS)
    mesh.remove_degenerate_triangles()
    mesh.remove_unreferenced_vertices()
    return to_surface(mesh)


def _noise(rng, width: int, height: int) -> np.ndarray:
    """Smooth colours with detail from 2 texels to a quarter of the image, float64 (height, width, 3), 0 to 1."""
    total = np.zeros((height, width, 3))
    y, x = np.mgrid[:height, :width] + 0.5
    period, weight = 2, 1.0
    while period <= max(2, min(width, height) // 4):
        coarse = rng.standard_normal((height // period + 2, width // period + 2, 3))
        total += weight * bilinear(coarse, x / period, y / period)
        period, weight = 2 * period, 1.15 * weight
    return np.clip(0.5 + 0.2 * (total - total.mean()) / total.std(), 0, 1)


def _photo(camera: Camera, depth: np.ndarray, texture: np.ndarray, pixel: float) -> np.ndarray:
    """uint8 (H, W, 3): means of _SAMPLES x _SAMPLES colours of what `depth`, drawn so much larger, shows; `pixel` is
    a texel's size."""
    large = camera.resized(depth.shape[1], depth.shape[0])
    rotation = camera.world_to_camera[:3, :3]
    places = (large.rays() * depth[..., None]) @ rotation + camera.center
    light = normals_of(depth, large) @ (rotation @ (_SUN / np.linalg.norm(_SUN)))
    shade = 1 - _SHADING + _SHADING * np.maximum(light, 0)
    colors = bilinear(texture, places[..., 0] / pixel + texture.shape[1] / 2,
                      places[..., 1] / pixel + texture.shape[0] / 2) * shade[..., None]
    colors[depth == 0] = 0
    mean = colors.reshape(camera.height, _SAMPLES, camera.width, _SAMPLES, 3).mean(axis=(1, 3))
    return np.rint(255 * mean).astype(np.uint8)
