"""What refined depth maps say of a mesh's vertices, each along its normal, on a device (method section 10.2)."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyopencl as cl

from pagas_cl.method.surface.raster import ACROSS, Drawing, eye_of
from pagas_cl.runtime.device import Device
from pagas_cl.runtime.host import side_by_side
from pagas_cl.runtime.memory import release, upload
from pagas_cl.runtime.program import build
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.depthmap import REFINED, nearest, stretched_depth

# Constants of section 10.2; they go into the kernel as they are.
SLOTS = 12              # observations that are kept for a vertex, the weightiest
MOST_WEIGHT = 4.0       # of a vertex' evidence, where the views are as sure as can be
WEIGHT_SHARE = 0.01     # squared footprints: (a tenth of one)^2, the least variance of a depth
REACH = 3.0             # footprints along the normal to depths of the same surface
DEFINES = (f"SLOTS={SLOTS}", f"NO_EDGE={REACH!r}f", f"MOST_WEIGHT={MOST_WEIGHT!r}f", f"WEIGHT_SHARE={WEIGHT_SHARE!r}f")
_AT_A_TIME = 8          # views that are made smaller
_OWN = (("observations", 8 * SLOTS), ("unit", 4), ("target", 4), ("weight", 4), ("seen", 4),
        ("sigma", 4))           # buffers, and bytes of each a vertex


@dataclass(frozen=True, eq=False)
class Observed:
    """A view's refined depth, 0 = no surface, and its standard deviation, infinite where no photo speaks for it:
    float32 (H, W), scene units."""

    camera: Camera
    depth: np.ndarray = field(repr=False)
    deviation: np.ndarray = field(repr=False)

    @classmethod
    def of(cls, result: Any, scale: float = 1.0) -> "Observed":
        """Of a DepthResult, at `scale` of its size: means of depths, the deviation in the middle."""
        depth = np.ascontiguousarray(result.depth, np.float32)
        deviation = np.where(result.status == REFINED, result.deviation, np.float32(np.inf))
        camera = result.camera.scaled(scale)
        return cls(camera, stretched_depth(depth, *camera.size), nearest(deviation, *camera.size))


class Observations(Sequence[Observed]):
    """What is observed, of DepthResults that are read when they are indexed: at `scale` of their size."""

    def __init__(self, results: Sequence[Any], scale: float = 1.0):
        self._results, self._scale = results, scale

    def __len__(self) -> int:
        return len(self._results)

    def __getitem__(self, index: Any) -> Any:
        return Observed.of(self._results[index], self._scale)


def sent(results: Sequence[Any], device: Device, scale: float = 1.0) -> Sequence[Observed]:
    """Observations of the DepthResults, once for all rounds, on a GPU where they take less than a quarter of its
    memory; smaller ones on a CPU, too."""
    views, count = Observations(results, scale), len(results)
    pixels = scale**2 * sum(result.camera.size.pixels for result in results)
    gpu = device.info.kind == "GPU"
    if 8 * pixels > device.memory.limit // 4 or not (gpu or scale < 1):
        return views
    held: list[Observed] = []
    for first in range(0, count, _AT_A_TIME):
        some = side_by_side(views.__getitem__, range(first, min(first + _AT_A_TIME, count)))
        held += [Observed(view.camera, upload(device, view.depth), upload(device, view.deviation)) if gpu else view
                 for view in some]
    return held


class VertexObservations:
    """What views say of the vertices of a mesh on the device. At least so many views (2 or more) must agree."""

    def __init__(self, device: Device, count: int, known: dict[str, Any], least_views: int):
        self.device, self.count, self.known, self.least_views = device, count, dict(known), least_views
        self.program = build(device, "mesh_evidence.cl", (*DEFINES, f"COLUMNS={min(device.lanes, ACROSS)}"))
        for name, size in _OWN:
            self.known[name] = device.buffer(size * count, name)
        cl.enqueue_fill_buffer(device.queue, self.known["observations"], np.float32(0), 0, 8 * SLOTS * count)
        cl.enqueue_fill_buffer(device.queue, self.known["seen"], np.int32(0), 0, 4 * count)
        cl.enqueue_fill_buffer(device.queue, self.known["unit"], np.float32(np.inf), 0, 4 * count)

    def gather(self, drawing: Drawing, views: Sequence[Observed], orientation: float) -> None:
        """Targets and weights of all vertices by what views say; `orientation` as mesh_solve.orientation_of says."""
        device, unit = self.device, 1 / drawing.frame.unit
        for view in views:
            own = {"drawn": drawing.draw(view.camera, unit),
                   "camera": upload(device, eye_of(view.camera, drawing.frame))}
            maps: dict[str, Any] = {"depth": view.depth, "deviation": view.deviation}
            for name, values in maps.items():
                if isinstance(values, np.ndarray):
                    own[name] = upload(device, values)
            self.program.run("gather", (self.count,), None, {**self.known, **maps, **own}, count=self.count, scale=unit,
                             orientation=orientation, least_views=self.least_views)
            device.queue.finish()
            release(*own.values())
        self.program.run("resolve", (self.count,), None, self.known, count=self.count, least_views=self.least_views)

    def release(self) -> None:
        for name, _ in _OWN:
            self.known[name].release()
