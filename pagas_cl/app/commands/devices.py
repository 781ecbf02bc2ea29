"""`pagas-cl devices`: what OpenCL offers on this machine, and what to install where it offers nothing."""

import sys
from itertools import groupby

import typer

from pagas_cl.app.commands import _options as options
from pagas_cl.runtime import listing, vendors
from pagas_cl.runtime.device import open_device
from pagas_cl.runtime.trial import try_device


def command(
    name: str = typer.Option(None, "--device", help="Also say which device this name would choose."),
    again: bool = typer.Option(False, "--again", help="Try each device anew, whatever an earlier trial has shown."),
    quiet: bool = options.QUIET,
):
    """List the OpenCL platforms and devices, their drivers, their memory, what each lacks, and whether it works.

    Each device that has what it takes is tried once: a step of the refinement is built and run on it in a process of
    its own, and compared with the same step in NumPy.
    """
    devices = [info for info, _ in listing.find_devices(vendors.import_pyopencl())]
    for platform, members in groupby(devices, key=lambda info: info.platform):
        sys.stdout.write(f"{platform}\n")
        for info in members:
            sys.stdout.write(_describe(info))
            sys.stdout.flush()
            sys.stdout.write(f"    tried          {_tried(info, again)}\n")
    chosen = open_device(name)
    sys.stdout.write(f"chosen: {chosen.info}{f', {chosen.lanes} lanes' if chosen.lanes > 1 else ''}\n")
    if not any(info.kind == "GPU" for info in devices):
        sys.stdout.write("no GPU among them; for one install its vendor's OpenCL driver\n")
    if vendors.intel_is_incomplete():
        sys.stdout.write('Intel\'s runtime for CPUs is installed in part: pip install "pagas-cl[cpu]" has all of it\n')
    with vendors.registered():
        complaints = vendors.loader_complaints()
    for line in complaints:
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


def _tried(info, again: bool) -> str:
    if info.lacks:
        return "no, since it lacks what is needed"
    trial = try_device(info, again)
    if not trial.lanes:
        return f"does not work: {trial.fault}"
    side_by_side = f"{trial.lanes} pixels side by side" if trial.lanes > 1 else "one pixel a work-item"
    return f"works, {side_by_side} (trial of {trial.seconds:.0f} s)" + (f"; {trial.fault}" if trial.fault else "")


def _size(number: int) -> str:
    return f"{number / 2**30:.1f} GB" if number >= 2**30 else f"{number / 2**20:.0f} MB"
