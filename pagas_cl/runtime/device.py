"""Choosing an OpenCL device and opening it: one context, one in-order queue."""

from __future__ import annotations

import logging
import os
import threading
import weakref
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from pagas_cl.errors import DeviceError, InputError, NoDeviceError
from pagas_cl.runtime import icd
from pagas_cl.runtime.info import DeviceInfo, describe

log = logging.getLogger("pagas_cl")

ENVIRONMENT = "PAGAS_CL_DEVICE"
SHARE = "PAGAS_CL_SHARE"  # how many processes may work on one device
# A driver may list a processor that its compiler does not know: believed only after a kernel has been built.
_TRIAL = "__kernel void trial(__global float *x) { x[get_global_id(0)] = exp(x[0]); }"
_told: set[DeviceInfo] = set()
_PREFERENCE = ("GPU", "accelerator", "CPU", "other")


@dataclass(frozen=True, eq=False)
class Device:
    """An open device: what it is, its context, and one in-order queue.

    Attributes
    ----------
    info : DeviceInfo
    cl_device : pyopencl.Device
    context : pyopencl.Context
    queue : pyopencl.CommandQueue
    profiling : bool
        Whether events of `queue` carry times.
    """

    info: DeviceInfo
    cl_device: Any
    context: Any
    queue: Any
    profiling: bool = False

    @cached_property
    def memory(self):
        """The buffers that this process holds on the device, counted: a runtime.memory.Memory."""
        from pagas_cl.runtime.memory import Memory, limit_of

        return Memory(self.info.title, limit_of(self.info.memory, shares()))

    def has(self, extension: str) -> bool:
        """Whether the device reports the OpenCL `extension`."""
        return extension in self.info.extensions


def open_device(name=None, *, profiling: bool = False) -> Device:
    """Open the OpenCL device called `name`.

    Parameters
    ----------
    name : str, Device or None
        Part of "platform / device", upper or lower case; "gpu" or "cpu" for the kind; "auto" for the best one (a GPU
        before a CPU). None takes the environment variable PAGAS_CL_DEVICE, and "auto" where it is not set. A Device is
        returned as it is.
    profiling : bool
        Record a start and an end time with every event of the queue.

    Raises
    ------
    DeviceError
        There is no platform, no device matches, the one that matches lacks something, or it cannot be opened. The
        message says what was found and what to install.
    """
    if isinstance(name, Device):
        return name
    cl = import_pyopencl()
    faults = []
    for info, cl_device in candidates(find_devices(cl), name):
        try:
            device = _still_open(cl, cl_device, profiling) or _keep(opened(info, cl_device, profiling))
        except cl.Error as error:
            faults.append(f"{info}: {_cause(error)}")
            log.warning("OpenCL device %s does not work and is passed over: %s", info, _cause(error))
            continue
        _tell(info, name)
        return device
    raise DeviceError(f"no OpenCL device that matches works: {'; '.join(faults)}. Is it in use by another process, or "
                      f"its driver older than the hardware? Choose another with device= or {ENVIRONMENT}. "
                      f"{icd.CPU_ADVICE}")


# Devices that this thread has open: a context of its own for every call would keep its programs, 20 MB, for ever.
_kept = threading.local()


def _keep(device: Device) -> Device:
    if hasattr(device.cl_device, "int_ptr"):
        vars(_kept)[f"{os.getpid()} {device.cl_device.int_ptr} {device.profiling}"] = device
    return device


def _still_open(cl, cl_device, profiling: bool) -> Device | None:
    """The device as this thread has opened it before, if it still answers."""
    key = f"{os.getpid()} {getattr(cl_device, 'int_ptr', None)} {profiling}"
    device = vars(_kept).get(key)
    if device is not None:
        try:
            cl.enqueue_marker(device.queue).wait()
        except cl.Error:       # lost, or reset: another context may do
            give_up(device)
        if device in _given_up:
            del vars(_kept)[key]
            return None
    return device


_given_up: weakref.WeakSet = weakref.WeakSet()


def give_up(device: Device) -> None:
    """Never use this context again: what it is asked for may fail or come out wrong."""
    _given_up.add(device)


def working(device: Device) -> Device:
    """`device`, or the same one opened anew where its context was given up.

    Raises
    ------
    DeviceError
        It cannot be opened again.
    """
    if device not in _given_up:
        return device
    try:
        return _keep(opened(device.info, device.cl_device, device.profiling))
    except import_pyopencl().Error as error:
        raise DeviceError(f"{device.info.title} was lost and cannot be opened again ({_cause(error)}): finished views "
                          "are kept, start the same command again or choose another device with "
                          f"{ENVIRONMENT}") from error


def opened(info: DeviceInfo, cl_device, profiling: bool = False) -> Device:
    """Open one device of `find_devices` and try it; a pyopencl error where it does not work."""
    cl = import_pyopencl()
    context = cl.Context([cl_device])
    properties = cl.command_queue_properties.PROFILING_ENABLE if profiling else 0
    queue = cl.CommandQueue(context, cl_device, properties=properties)
    cl.Program(context, _TRIAL).build(["-cl-std=CL1.2"])
    return Device(info, cl_device, context, queue, profiling)


def shares() -> int:
    """How many processes may work on one device."""
    text = os.environ.get(SHARE, "1")
    if not text.isdigit() or int(text) < 1:
        raise InputError(f"environment variable {SHARE} is {text!r}, expected a whole number of at least 1")
    return int(text)


def import_pyopencl():
    """The pyopencl module, or a DeviceError that says what is wrong with it."""
    try:
        import pyopencl
    except ImportError as error:
        raise NoDeviceError(icd.no_pyopencl(error)) from error
    return pyopencl


def find_devices(cl) -> list[tuple[DeviceInfo, Any]]:
    """Every device of every platform, in the platforms' order, as (DeviceInfo, pyopencl.Device).

    Raises
    ------
    DeviceError
        The loader finds no platform, or the platforms have no device.
    """
    try:
        platforms = cl.get_platforms()
    except cl.Error as error:
        raise NoDeviceError(icd.no_platform(str(error))) from error
    if not platforms:
        raise NoDeviceError(icd.no_platform())
    found = []
    for platform in platforms:
        try:
            devices = platform.get_devices()
        except cl.Error as error:
            log.warning("OpenCL platform %s: its devices cannot be listed: %s", platform.name, error)
            continue
        found += [(describe(cl, platform, device), device) for device in devices]
    if not found:
        raise NoDeviceError(icd.no_device([platform.name.strip() for platform in platforms]))
    return found


def trial_fault(cl, cl_device) -> str:
    """Why the device cannot be opened or cannot compile a small kernel; an empty string where it can."""
    try:
        cl.Program(cl.Context([cl_device]), _TRIAL).build(["-cl-std=CL1.2"])
    except cl.Error as error:
        return _cause(error)
    return ""


def _asked(name) -> tuple[str, str]:
    """What device was asked for, and by what: the argument or the environment variable."""
    if name is None:
        return os.environ.get(ENVIRONMENT) or "auto", ENVIRONMENT
    return str(name), "device"


def _cause(error) -> str:
    """The line of an OpenCL error that says what is wrong."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return next((line for line in lines if line.startswith("error:")), lines[0] if lines else repr(error))


def candidates(found, name):
    """The (DeviceInfo, device) pairs of `found` that `name` means, best first; see open_device."""
    name, source = _asked(name)
    wanted = name.strip().lower()
    matching = [pair for pair in found if wanted == "auto" or _matches(pair[0], wanted)]
    if not matching:
        names = "; ".join(info.title for info, _ in found)
        raise NoDeviceError(f"no OpenCL device matches {source}={name!r}; found: {names}")
    usable = [pair for pair in matching if not pair[0].lacks]
    if not usable:
        reasons = "; ".join(f"{info.title} lacks {', '.join(info.lacks)}" for info, _ in matching)
        raise NoDeviceError(f"no usable OpenCL device: {reasons}. {icd.CPU_ADVICE}")
    return sorted(usable, key=lambda pair: (_PREFERENCE.index(pair[0].kind), -pair[0].compute_units))


def _tell(info: DeviceInfo, name):
    """Log the choice, once a process for each device: one run may open it for every view."""
    if info in _told:
        return
    _told.add(info)
    log.info("OpenCL device: %s", info)
    if _asked(name)[0].strip().lower() == "auto" and info.kind != "GPU":
        log.warning("no usable OpenCL GPU found: running on %s, which is many times slower; "
                    "'pagas-cl devices' tells what is missing", info)


def _matches(info: DeviceInfo, wanted: str) -> bool:
    return wanted in info.title.lower() or wanted == info.kind.lower()
