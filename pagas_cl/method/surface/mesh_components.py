"""Connected components of a mesh, on a device (method section 10.5)."""

from __future__ import annotations

import numpy as np

from pagas_cl.runtime.device import Device, translate_cl_errors
from pagas_cl.runtime.memory import download, upload
from pagas_cl.runtime.program import bind, build, run_once


def components_of(device: Device, faces: np.ndarray, count: int) -> np.ndarray:
    """Component of each of `count` vertices: int32 (count,), the least vertex index of its component."""
    with translate_cl_errors(device, "looking for the parts of the mesh"):
        known = {"faces": upload(device, faces), "least": upload(device, np.arange(count, dtype=np.int32)),
                 "component": device.memory.buffer(device.context, 4 * count, "component")}
        program = build(device, "mesh_components.cl")
        run_once(device.queue, [bind(program, "connect", (len(faces),), None, known, count=len(faces)),
                                bind(program, "find_components", (count,), None, known, count=count)])
        component = download(device, known["component"], count, np.int32)
        for buffer in known.values():
            buffer.release()
    return component
