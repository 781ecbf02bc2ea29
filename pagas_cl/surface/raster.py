"""Depth maps of a mesh, by Open3D's ray casting.

Rays go through the pixel centres at +0.5 and have camera z = 1, so that the hit's parameter is the z-depth. They are
made here, in float64, relative to the middle of the mesh and in units of its size: neither Open3D's pixel-centre
convention nor an origin 5e6 away enters.
"""

from collections.abc import Iterable, Iterator

import numpy as np

from pagas_cl.errors import InputError, need
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.mesh import Surface

_RAYS = 1 << 21  # rays cast at a time: 48 MB of float32 and twice that while they are made


def each_depth(surface: Surface, cameras: Iterable[Camera]) -> Iterator[np.ndarray]:
    """Depth map (H, W) float32 of `surface` in every camera, one at a time, in their order; 0 = no surface."""
    o3d = need("open3d", "mesh", "rendering a mesh to depth maps")
    if len(surface.faces) == 0:
        raise InputError("the mesh has no faces, expected triangles; a point cloud cannot be rendered to depth")
    used = surface.vertices[np.unique(surface.faces)]
    low, high = used.min(axis=0), used.max(axis=0)
    middle, mesh_scale = (low + high) / 2, float(np.linalg.norm(high - low)) or 1.0
    vertices = np.ascontiguousarray((surface.vertices - middle) / mesh_scale, np.float32)
    scene, tensor = o3d.t.geometry.RaycastingScene(), o3d.core.Tensor
    scene.add_triangles(tensor(vertices), tensor(np.ascontiguousarray(surface.faces, np.uint32)))
    for camera in cameras:
        depth = np.empty((camera.height, camera.width), np.float32)
        step = max(1, _RAYS // camera.width)
        rotation, origin = camera.world_to_camera[:3, :3], (camera.center - middle) / mesh_scale
        x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
        for start in range(0, camera.height, step):
            y = (np.arange(start, min(start + step, camera.height)) + 0.5 - camera.cy) / camera.fy
            rays = np.empty((len(y), camera.width, 6), np.float32)
            rays[..., :3] = origin
            # a ray in the world is x r0 + y r1 + r2, with r the rows of the rotation
            rays[..., 3:] = x[None, :, None] * rotation[0] + (y[:, None, None] * rotation[1] + rotation[2])
            hit = scene.cast_rays(tensor(rays))["t_hit"].numpy()
            depth[start:start + step] = np.where(np.isfinite(hit), hit * mesh_scale, 0)
        yield depth
