"""Depth maps of a mesh (method section 10.1): drawn on a device, or by Open3D's ray casting where there is none.

Either way depth is that of the rays through the pixel centres at +0.5, and neither an origin 5e6 away nor the unit
enters: places are taken relative to the middle of the mesh, in units of its size, in float64 before they are rounded.
"""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
import pyopencl as cl

from pagas_cl.errors import need
from pagas_cl.runtime.device import Device, translate_cl_errors
from pagas_cl.runtime.memory import download, release, upload
from pagas_cl.runtime.program import GROUP_1D, Upload, build
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.mesh import Surface

_RAYS = 1 << 21   # rays cast at a time: 48 MB of float32 and twice that while they are made
_PART = 1 << 21   # triangles drawn at a time where the mesh takes more than a quarter of the device's memory
_GROUP, _GROUPS = 64, 1024     # work-items that share a large triangle; work-groups that large triangles go to in turn
ACROSS = 8        # pixels side by side: most triangles, and windows around vertices, are no wider
_EMPTY = np.uint32(0x7F800000)
_SEEN = 20        # bytes of what a camera sees of a vertex


class Frame(NamedTuple):
    """What a mesh is handled in: middle (3,) and size of what its faces span, scene units."""

    middle: np.ndarray
    unit: float

    def local(self, places: np.ndarray) -> np.ndarray:
        """Places (V, 3) as kernels take them, float32."""
        found: np.ndarray = ((places - self.middle) / self.unit).astype(np.float32)
        return found


def each_depth(surface: Surface, cameras: Iterable[Camera], device: Device | None = None) -> Iterator[np.ndarray]:
    """Depth map (H, W) float32 of `surface` in every camera, one at a time, in their order; 0 = no surface. Drawn on
    `device`; without one by Open3D."""
    if device is None:
        yield from _cast(surface, cameras)
        return
    drawing = Drawing(device, surface)
    for camera in cameras:
        yield drawing.depth(camera)


def frame_of(surface: Surface) -> Frame:
    used = np.zeros(len(surface.vertices), bool)
    used[surface.faces] = True
    columns = (surface.vertices if used.all() else surface.vertices[used]).T
    low, high = (np.array([find(column) for column in columns]) for find in (np.min, np.max))
    return Frame((low + high) / 2, float(np.linalg.norm(high - low)) or 1.0)


class _Part:
    """`count` triangles on a device, their `number` vertices, and room for what a camera sees of these."""

    def __init__(self, device: Device, vertices: np.ndarray, faces: np.ndarray):
        self.number, self.count = len(vertices), len(faces)
        self.vertices, self.faces = upload(device, vertices), upload(device, faces)
        self.seen = device.buffer(_SEEN * len(vertices), "seen")
        self.large = device.buffer(4 * (1 + len(faces)), "large")

    def release(self) -> None:
        release(self.vertices, self.faces, self.seen, self.large)


class Drawing:
    """A mesh on a device, to be drawn in any number of cameras. Where it takes more than a quarter of the device's
    memory, its triangles go there in parts for each camera."""

    def __init__(self, device: Device, surface: Surface):
        self.device, self.frame = device, frame_of(surface)
        self._vertices = self._in_frame(surface.vertices)
        self._faces = np.ascontiguousarray(surface.faces, np.int32)
        taken = self._vertices.nbytes + self._faces.nbytes + _SEEN * len(self._vertices) + 4 * len(self._faces)
        whole = taken <= device.memory.limit // 4
        self._held = [_Part(device, self._vertices, self._faces)] if whole else None

    def move(self, vertices: np.ndarray) -> None:
        """Put the vertices at other places, (V, 3) in world coordinates; the frame stays."""
        self._vertices = self._in_frame(vertices)
        if self._held is not None:
            Upload(self._held[0].vertices, self._vertices).enqueue(self.device.queue).wait()

    def _in_frame(self, vertices: np.ndarray) -> np.ndarray:
        """(V, 2, 3) float32: coordinates rounded, and what is left of them."""
        local = (vertices - self.frame.middle) / self.frame.unit
        rounded = local.astype(np.float32)
        return np.stack([rounded, (local - rounded).astype(np.float32)], axis=1)

    def _parts(self) -> Iterator[_Part]:
        if self._held is not None:
            yield from self._held
            return
        for start in range(0, len(self._faces), _PART):
            used, faces = np.unique(self._faces[start:start + _PART], return_inverse=True)
            part = _Part(self.device, self._vertices[used], faces.reshape(-1, 3).astype(np.int32))
            yield part
            self.device.queue.finish()
            part.release()

    def draw(self, camera: Camera, unit: float) -> cl.Buffer:
        """A buffer of float32 (H, W), to be released: depth, 0 = no surface; `unit` is a scene unit in its unit."""
        device, pixels = self.device, camera.size.pixels
        program = build(device, "raster.cl", (f"COLUMNS={device.columns(camera.width, ACROSS)}",))
        z_buffer = device.buffer(4 * pixels, "z_buffer")
        cl.enqueue_fill_buffer(device.queue, z_buffer, _EMPTY, 0, 4 * pixels)
        eye = upload(device, eye_of(camera, self.frame))
        for part in self._parts():
            cl.enqueue_fill_buffer(device.queue, part.large, np.uint32(0), 0, 4)
            known = {**vars(part), "camera": eye, "z_buffer": z_buffer}
            program.run("look", (part.number,), GROUP_1D, known, count=part.number)
            program.run("draw", (part.count,), GROUP_1D, known)
            program.run("draw_large", (_GROUP * min(_GROUPS, part.count),), (_GROUP,), known)
        program.run("to_depth", (pixels,), z_buffer=z_buffer, count=pixels, unit=self.frame.unit * unit)
        return z_buffer

    def depth(self, camera: Camera) -> np.ndarray:
        """Depth map (H, W) float32 in scene units, 0 = no surface."""
        with translate_cl_errors(self.device, f"the drawing of the mesh in view {camera.name!r}"):
            z_buffer = self.draw(camera, 1.0)
            depth = download(self.device, z_buffer, camera.size.shape)
        z_buffer.release()
        return depth


def eye_of(camera: Camera, frame: Frame) -> np.ndarray:
    """A camera as eye.clh reads it, in the frame of a mesh: float32 (23,)."""
    center = (camera.center - frame.middle) / frame.unit
    rounded = center.astype(np.float32)
    return np.array([*camera.world_to_camera[:3, :3].ravel(), *rounded, *(center - rounded), camera.fx, camera.fy,
                     camera.cx, camera.cy, 1 / camera.fx, 1 / camera.fy, camera.width, camera.height], np.float32)


def _cast(surface: Surface, cameras: Iterable[Camera]) -> Iterator[np.ndarray]:
    """`each_depth` by Open3D. Its rays have camera z = 1, so that the hit's parameter is the z-depth."""
    o3d = need("open3d", "mesh", "rendering a mesh to depth maps without an OpenCL device")
    frame, scene, tensor = frame_of(surface), o3d.t.geometry.RaycastingScene(), o3d.core.Tensor
    scene.add_triangles(tensor(frame.local(surface.vertices)), tensor(np.ascontiguousarray(surface.faces, np.uint32)))
    for camera in cameras:
        depth = np.empty(camera.size.shape, np.float32)
        step = max(1, _RAYS // camera.width)
        rotation, origin = camera.world_to_camera[:3, :3], (camera.center - frame.middle) / frame.unit
        x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
        for start in range(0, camera.height, step):
            y = (np.arange(start, min(start + step, camera.height)) + 0.5 - camera.cy) / camera.fy
            rays = np.empty((len(y), camera.width, 6), np.float32)
            rays[..., :3] = origin
            # a ray in the world is x r0 + y r1 + r2, with r the rows of the rotation
            rays[..., 3:] = x[None, :, None] * rotation[0] + (y[:, None, None] * rotation[1] + rotation[2])
            hit = scene.cast_rays(tensor(rays))["t_hit"].numpy()
            depth[start:start + step] = np.where(np.isfinite(hit), hit * frame.unit, 0)
        yield depth
