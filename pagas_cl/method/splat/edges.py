"""Launches of edges.cl: which of the surfaces next to an edge of depth a pixel shows (method section 8.4)."""

from collections.abc import Callable, Mapping

import numpy as np
import pyopencl as cl

from pagas_cl.config import Config
from pagas_cl.method.splat import hypotheses
from pagas_cl.method.splat.constants import SHARED
from pagas_cl.method.splat.inputs import LevelInput, enqueue_each
from pagas_cl.method.splat.units import NormalizedDepth
from pagas_cl.runtime.memory import constant, download, release, upload
from pagas_cl.runtime.program import bind, build

_NUMBER = 1 + hypotheses.AROUND      # depths that a pixel may have: its own first
_MOST = 1 << 17                      # pixels whose colours are compared at a time; more memory
NBYTES = 5 * _NUMBER + 1             # a pixel, in addition to those


def choose_surfaces(device, given: LevelInput, config: Config, depth: NormalizedDepth, known: Mapping[str, cl.Buffer],
                    count_support: Callable[[cl.Buffer, int, cl.Buffer], None]) -> None:
    """Change depth, deviation and status in `known` where a pixel shows another surface. `known`: these, the depth
    before it was averaged (own_depth), and parallax of the target, on the device, lengths in scene units; `depth`: the
    same in units. `count_support(candidates, number, support)` adds what other views' depth maps say
    (Agreement.count_support)."""
    target, *others = given.views(config)
    views, size = others[:min(given.contexts, hypotheses.MOST_VIEWS)], target.size
    program = build(device, "edges.cl", (*SHARED, *hypotheses.OWN_DEFINES))
    candidates, support = (device.buffer(nbytes * _NUMBER * size.pixels) for nbytes in (4, 1))
    held = {"candidates": candidates, "support": support, "scale": 1 / given.scene_scale, **size.extent}
    program.run("extend_planes", size, None, held, depth=depth.buffer, own_depth=known["own_depth"],
                depth_per_parallax=known["parallax"], status=known["status"])
    count_support(candidates, _NUMBER, support)
    supported = device.buffer(size.pixels)
    program.run("list_supported", (size.pixels,), None, held, count=size.pixels, supported=supported)
    cameras = constant(device, given.camera_table)
    places = np.flatnonzero(download(device, supported, size.pixels, np.uint8)).astype(np.int32)
    known = {name: known[name] for name in ("depth", "deviation", "status")}

    def compare(part: np.ndarray) -> None:
        costs, listed = device.buffer(4 * len(views) * _NUMBER * len(part)), upload(device, part)
        given_here = {**held, "cameras": cameras, "places": listed, "count": len(part), "costs": costs}
        enqueue_each(device.queue, views, lambda view: [
            bind(program, "score_colors", (len(part),), None, {**given_here, **view.arguments})])
        program.run("choose_surface", (len(part),), None, given_here, views=len(views), target_photo=target.photo,
                    **known)
        release(costs, listed)

    for first in range(0, len(places), _MOST):
        compare(places[first:first + _MOST])
    release(candidates, support, supported)
