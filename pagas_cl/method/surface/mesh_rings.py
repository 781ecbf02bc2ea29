"""Numbers grouped on a device, and with that what is around the vertices of a mesh (method section 10.2)."""

import numpy as np
import pyopencl as cl

from pagas_cl.runtime.device import Device
from pagas_cl.runtime.memory import download, upload
from pagas_cl.runtime.program import Upload, bind, build, run_once


def grouped(device: Device, numbers: cl.Buffer, number: int, count: int) -> tuple[cl.Buffer, cl.Buffer]:
    """Where each of `count` values begins among so many `numbers` (N,) in their order, int32 (count + 1,), and that
    order (N,) int32: what is equal keeps its order. To be released."""
    program, first = build(device, "mesh_rings.cl"), np.zeros(count + 1, np.int32)
    known = {"numbers": numbers, "next": upload(device, first), "order": device.buffer(4 * number, "order")}
    program.run("count_numbers", (number,), None, known, count=number)
    np.cumsum(download(device, known["next"], count, np.int32), out=first[1:])
    known["first"] = upload(device, first)
    run_once(device.queue, [Upload(known["next"], first),
                            bind(program, "list_places", (number,), None, known, count=number),
                            bind(program, "sort_places", (count,), None, known, count=count)])
    known["next"].release()
    return known["first"], known["order"]


def rings_of(device: Device, faces: cl.Buffer, number: int, count: int) -> dict[str, cl.Buffer]:
    """Of `number` faces (F, 3) int32 and `count` vertices: "first" (V + 1,) int32, where each vertex' corners begin,
    and "pairs" (3 F, 2), the two other corners of the triangle of each. To be released."""
    first, order = grouped(device, faces, 3 * number, count)
    pairs = device.buffer(24 * number, "pairs")
    build(device, "mesh_rings.cl").run("find_pairs", (3 * number,), faces=faces, order=order, count=3 * number,
                                       pairs=pairs)
    order.release()
    return {"first": first, "pairs": pairs}
