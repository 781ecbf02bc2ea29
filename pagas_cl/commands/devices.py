"""`pagas-cl devices`: what OpenCL offers on this machine, and what to install where it offers nothing."""

from __future__ import annotations

import sys
from itertools import groupby

import typer


def command(
    name: str = typer.Option(None, "--device", help="Also say which device this name would choose."),
):
    """List the OpenCL platforms and devices, their drivers, their memory, and what each lacks."""
    from pagas_cl.runtime import icd
    from pagas_cl.runtime.device import open_device
    from pagas_cl.runtime.listing import list_devices

    devices = list_devices()
    for platform, members in groupby(devices, key=lambda info: info.platform):
        sys.stdout.write(f"{platform}\n" + "".join(_describe(info) for info in members))
    chosen = open_device(name)
    sys.stdout.write(f"chosen: {chosen.info}\n")
    if not any(info.kind == "GPU" for info in devices):
        sys.stdout.write("no GPU among them; for one install its vendor's OpenCL driver\n")
    for line in icd.loader_complaints():
        sys.stdout.write(f"a driver is registered but cannot be loaded: {line}\n")


def _describe(info) -> str:
    lines = [
        f"  {info.name}",
        f"    kind           {info.kind}, {info.compute_units} compute units, work-groups up to {info.work_group}",
        f"    version        {info.version}; {info.c_version}",
        f"    driver         {info.driver}",
        f"    memory         {_size(info.memory)}, largest buffer {_size(info.max_alloc)}, "
        f"local {info.local_memory // 1024} kB",
        f"    lacks          {'; '.join(info.lacks) or 'nothing that is needed'}",
    ]
    if info.does_without:
        lines.append(f"    does without   {'; '.join(info.does_without)}")
    return "\n".join(lines) + "\n"


def _size(number: int) -> str:
    return f"{number / 2**30:.1f} GB" if number >= 2**30 else f"{number / 2**20:.0f} MB"
