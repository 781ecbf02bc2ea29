"""Depth maps of a mesh, by Open3D's ray casting.

Convention: rays go through the pixel centres at +0.5 and have camera z = 1, so that the hit's parameter is the z-depth.
Rays are made here from `Camera`, in float64, relative to the middle of the mesh and in units of its size: neither
Open3D's pixel-centre convention nor an origin 5e6 away enters. A camera for another image size must be scaled with its
image (`Camera.resized`): K belongs to a size in pixels.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from pagas_cl.errors import InputError, need
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.mesh import Surface

_RAYS = 1 << 21  # rays cast at a time: 48 MB of float32 and twice that while they are made


def render_depths(surface: Surface, cameras: Iterable[Camera]) -> list[np.ndarray]:
    """Depth map (H, W) float32 of `surface` in every camera, 0 = no surface."""
    return list(each_depth(surface, cameras))


def each_depth(surface: Surface, cameras: Iterable[Camera]) -> Iterator[np.ndarray]:
    """The same, one at a time, in the order of `cameras`."""
    caster = Caster(surface)
    for camera in cameras:
        yield caster.depth(camera)


class Caster:
    """A mesh made ready for ray casting: build once, ask for many cameras."""

    def __init__(self, surface: Surface):
        o3d = need("open3d", "mesh", "rendering a mesh to depth maps")
        if len(surface.faces) == 0:
            raise InputError("the mesh has no faces, expected triangles; a point cloud cannot be rendered to depth")
        used = surface.vertices[np.unique(surface.faces)]
        low, high = used.min(axis=0), used.max(axis=0)
        self.middle = (low + high) / 2
        self.mesh_scale = float(np.linalg.norm(high - low)) or 1.0
        vertices = np.ascontiguousarray((surface.vertices - self.middle) / self.mesh_scale, np.float32)
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(o3d.core.Tensor(vertices),
                                  o3d.core.Tensor(np.ascontiguousarray(surface.faces, np.uint32)))
        self._tensor = o3d.core.Tensor

    def depth(self, camera: Camera) -> np.ndarray:
        """Depth map (H, W) float32 of the mesh in `camera`, 0 = no surface."""
        depth = np.empty((camera.height, camera.width), np.float32)
        step = max(1, _RAYS // camera.width)
        rotation = camera.world_to_camera[:3, :3]
        origin = (camera.center - self.middle) / self.mesh_scale
        x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
        for start in range(0, camera.height, step):
            y = (np.arange(start, min(start + step, camera.height)) + 0.5 - camera.cy) / camera.fy
            rays = np.empty((len(y), camera.width, 6), np.float32)
            rays[..., :3] = origin
            # a ray in the world is x r0 + y r1 + r2, with r the rows of the rotation
            rays[..., 3:] = x[None, :, None] * rotation[0] + (y[:, None, None] * rotation[1] + rotation[2])
            hit = self._scene.cast_rays(self._tensor(rays))["t_hit"].numpy()
            depth[start:start + step] = np.where(np.isfinite(hit), hit * self.mesh_scale, 0)
        return depth
