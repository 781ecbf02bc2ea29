"""Choosing an OpenCL device and opening it: one context, one in-order queue; or a caller's own queue."""

import os
import re
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeAlias

from pagas_cl.errors import DeviceError, DeviceLostError, DeviceMemoryError, InputError, NoDeviceError, kind_of, log
from pagas_cl.runtime.info import DeviceInfo, describe, number_in
from pagas_cl.runtime.listing import find_devices
from pagas_cl.runtime.trial import Trial, try_device
from pagas_cl.runtime.vendors import begin_process, check_process, cpu_advice, import_pyopencl

if TYPE_CHECKING:
    from pyopencl import Buffer

    from pagas_cl.runtime.allocations import Memory

ENVIRONMENT = "PAGAS_CL_DEVICE"      # the name that `open_device(None)` takes
SHARE = "PAGAS_CL_SHARE"             # how many processes may work on one device
SPARE = 1 / 8     # share of a GPU's memory that waiting buffers may take beyond what is planned; less frees more often
_PREFERENCE = ("GPU", "accelerator", "CPU", "other")      # kinds of devices, best first


@dataclass(eq=False)
class Device:
    """An open device: what it is, its context, one in-order queue, and what was compiled and allocated in them."""

    info: DeviceInfo
    cl_device: Any
    context: Any
    queue: Any
    lanes: int = 1
    """Pixels of a row that a work-item handles side by side: the most that have been seen to work here."""
    is_callers: bool = False
    """Whether context and queue are the caller's (`Device.of`): they are never replaced by others."""
    is_lost: bool = False
    """Whether the context has failed: whatever it does later may fail or come out wrong."""
    programs: dict[tuple[str, tuple[str, ...], Any], Any] = field(default_factory=dict, repr=False)
    """Each program.Program that was compiled, by file, defines and the queue that it runs in."""
    constants: dict[bytes, Any] = field(default_factory=dict, repr=False)
    """Buffers of `memory.constant`, by their bytes."""

    @classmethod
    def of(cls, queue: Any) -> "Device":
        """The device, context and queue of a caller's pyopencl.CommandQueue, for everything that takes `device=`.

        All work is enqueued there, and has ended when a public function returns; the queue must be in-order, its
        context kept by the caller: Intel's runtime frees it under a queue that lives. The device is tried as in
        open_device. InputError: no such queue. DeviceError: the device lacks something, or has failed its trial.
        """
        cl = import_pyopencl()
        if not isinstance(queue, cl.CommandQueue):
            raise InputError(f"queue is {kind_of(queue)}, expected a pyopencl.CommandQueue")
        if queue.properties & cl.command_queue_properties.OUT_OF_ORDER_EXEC_MODE_ENABLE:
            raise InputError("queue executes out of order, expected a pyopencl.CommandQueue(context) that does not")
        try:
            context = queue.context
        except cl.LogicError as error:
            raise InputError(f"queue has no context ({error}): keep the pyopencl.Context as long as the queue"
                             ) from error
        begin_process()
        info = describe(cl, queue.device.platform, queue.device)
        trial = None if info.lacks else try_device(info)
        if trial is None or not trial.lanes:
            lacks = ", ".join(info.lacks) if trial is None else f"a driver that works ({trial.fault})"
            raise DeviceError(f"the queue's device {info.title} lacks {lacks}: see 'pagas-cl devices'")
        return cls(info, queue.device, context, queue, trial.lanes, is_callers=True)

    @cached_property
    def memory(self) -> "Memory":
        """The buffers that this process holds on the device, counted."""
        from pagas_cl.runtime.allocations import Memory, limit_of

        spare = 0 if self.info.kind == "CPU" else SPARE      # its memory is the host's, and soon freed
        return Memory(self.info.title, limit_of(self.info.memory, shares()), spare)

    def buffer(self, nbytes: int, role: str = "") -> "Buffer":
        """As Memory.buffer."""
        return self.memory.buffer(self.context, nbytes, role)

    def has(self, extension: str) -> bool:
        """Whether the device reports the OpenCL `extension`."""
        return extension in self.info.extensions

    def columns(self, width: int, most: int = 16) -> int:
        """Pixels of a row of `width` that one work-item handles side by side: all lanes up to `most`, or 1; 1 on a
        GPU."""
        lanes = min(self.lanes, most)
        return lanes if lanes <= width else 1


# One device, by its name or open, or several, by a list of names or "all".
Devices: TypeAlias = str | Device | list[str] | tuple[str, ...]


def open_device(name: str | Device | None = None) -> Device:
    """Open the OpenCL device called `name`, if a trial has shown that it works (runtime.trial; made once a driver).

    `name` is part of "platform / device", upper or lower case; "gpu" or "cpu"; "auto" for the best one (a GPU before a
    CPU). None takes the environment variable PAGAS_CL_DEVICE, else "auto". A Device is returned unchanged.

    DeviceError: there is no platform, no device matches, the one that matches lacks something, has failed its trial, or
    cannot be opened. The message says what was found and what to install.
    """
    if isinstance(name, Device):
        check_process()
        return name
    cl = import_pyopencl()
    faults = []
    for info, cl_device in candidates(find_devices(cl), name):
        trial = try_device(info)
        fault, device = trial.fault, _still_open(cl, cl_device) if trial.lanes else None
        if device is not None:
            return device
        if trial.lanes:
            try:
                device = _keep(opened(info, cl_device, trial.lanes))
                _log_choice(device, name, trial)
                return device
            except cl.Error as error:
                fault = cause(error)
        faults.append(f"{info}: {fault}")
        log.warning("OpenCL device %s does not work and is not used: %s", info, fault)
    raise DeviceError(f"no OpenCL device that matches works: {'; '.join(faults)}. Is it in use by another process, or "
                      "its driver older than the hardware ('pagas-cl devices --again' tries anew)? Choose another "
                      f"with device= or {ENVIRONMENT}. {cpu_advice()}")


# A cache, by process and device: what this thread has opened serves later calls, too. With a context of its own each
# call would compile all kernels anew, and count no buffers but its own.
_open_devices = threading.local()


def _key(cl_device: Any) -> str:
    return f"{os.getpid()} {getattr(cl_device, 'int_ptr', None)}"


def _keep(device: Device) -> Device:
    if hasattr(device.cl_device, "int_ptr"):
        vars(_open_devices)[_key(device.cl_device)] = device
    return device


def _still_open(cl: Any, cl_device: Any) -> Device | None:
    """The device as this thread has opened it before, if it still answers."""
    key = _key(cl_device)
    device: Device | None = vars(_open_devices).get(key)
    if device is not None and not device.is_lost:
        try:
            cl.enqueue_marker(device.queue).wait()
            return device
        except cl.Error:       # lost, or reset: another context may do
            device.is_lost = True
    vars(_open_devices).pop(key, None)
    return None


def working(device: Device) -> Device:
    """`device`, or the same one opened anew where its context is lost; DeviceError where it cannot be."""
    check_process()
    if not device.is_lost:
        return device
    if device.is_callers:
        raise DeviceError(f"the caller's queue on {device.info.title} has failed: finished views are kept, make a new "
                          "context and queue and start the same call again")
    try:
        return _keep(opened(device.info, device.cl_device, device.lanes))
    except import_pyopencl().Error as error:
        raise DeviceError(f"{device.info.title} has failed and cannot be opened again ({cause(error)}): finished views "
                          "are kept, start the same command again or choose another device with "
                          f"{ENVIRONMENT}") from error


def is_remote(executor: Any, devices: Any) -> bool:
    """Whether these arguments of refine_views mean other processes than this one."""
    return executor is not None or devices == "all" or isinstance(devices, (list, tuple))


def one_of(devices: Any) -> Any:
    """The device to work on in this process, by name or open, of what refine_views takes: the first of several."""
    if isinstance(devices, (list, tuple)):
        devices = devices[0] if devices else None
    return None if isinstance(devices, str) and devices == "all" else devices


def opened(info: DeviceInfo, cl_device: Any, lanes: int) -> Device:
    """Open one device of `find_devices` with `lanes` that it works with; a pyopencl error where it cannot be opened."""
    cl = import_pyopencl()
    context = cl.Context([cl_device])
    device = Device(info, cl_device, context, cl.CommandQueue(context, cl_device), lanes)
    device.memory      # noqa: B018  (InputError where PAGAS_CL_MEMORY is no number: now, and not in the first view)
    return device


# What the driver says when a device fails in the middle of work.
_MEMORY = ("MEM_OBJECT_ALLOCATION_FAILURE", "OUT_OF_HOST_MEMORY")
_LOST = ("OUT_OF_RESOURCES", "DEVICE_NOT_AVAILABLE", "DEVICE_NOT_FOUND", "INVALID_DEVICE", "INVALID_COMMAND_QUEUE",
         "INVALID_CONTEXT", "EXEC_STATUS_ERROR_FOR_EVENTS_IN_WAIT_LIST")
_OF_DRIVERS = -9999       # NVIDIA's code for an access that its hardware refused; below -1000 each maker has its own


@contextmanager
def translate_cl_errors(device: Device, doing: str) -> Iterator[None]:
    """Context: errors of the driver while `doing` (a noun phrase) on `device` become errors of pagas_cl; others pass.

    DeviceMemoryError: it has no memory left, fewer buffers may do. DeviceLostError: it answers no more, or has ended
    what it was at; the device is marked as lost.
    """
    import pyopencl as cl  # which the device has loaded: no driver is looked for any more

    check_process()
    title = device.info.title
    try:
        yield
    except cl.Error as error:
        code = getattr(error, "code", 0)
        if code in [getattr(cl.status_code, name) for name in _MEMORY]:
            raise DeviceMemoryError(f"{title} ran out of memory during {doing} ({error})") from error
        if code in [getattr(cl.status_code, name) for name in _LOST] or code <= _OF_DRIVERS:
            device.is_lost = True
            raise DeviceLostError(f"{title} failed during {doing} ({error}): start the same command again, which goes "
                                  "on from the views that are on disk; where it fails again, update its driver or "
                                  "choose another device (pagas-cl devices)") from error
        raise


def shares() -> int:
    """How many processes may work on one device."""
    return int(number_in(SHARE, "1", "a whole number of at least 1", lambda number: number >= 1 and number % 1 == 0))


def _requested(name: object) -> tuple[str, str]:
    """What device was requested, and by what: the argument or the environment variable."""
    if name is None:
        return os.environ.get(ENVIRONMENT) or "auto", ENVIRONMENT
    return str(name), "device"


def cause(error: Exception) -> str:
    """The line of an OpenCL error that says what is wrong."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return next((line for line in lines if "error" in line.lower()), lines[0] if lines else repr(error))


def candidates(found: Iterable[tuple[DeviceInfo, Any]], name: object) -> list[tuple[DeviceInfo, Any]]:
    """The (DeviceInfo, device) pairs of `found` that `name` means, best first; see open_device."""
    requested, source = _requested(name)
    wanted = requested.strip().lower()
    matching = [pair for pair in found if wanted in ("auto", pair[0].kind.lower())
                or wanted in pair[0].title.lower()]
    if not matching:
        names = "; ".join(info.title for info, _ in found)
        raise NoDeviceError(f"no OpenCL device matches {source}={requested!r}; found: {names}")
    usable = [pair for pair in matching if not pair[0].lacks]
    if not usable:
        reasons = "; ".join(f"{info.title} lacks {', '.join(info.lacks)}" for info, _ in matching)
        raise NoDeviceError(f"no usable OpenCL device: {reasons}. {cpu_advice()}")
    return sorted(usable, key=lambda pair: _rank(pair[0]))


def _rank(info: DeviceInfo) -> tuple[int, int, bool, list[int]]:
    """Smaller is better. Of two drivers for one processor Intel's is a quarter to a half faster than PoCL; of two PoCL
    the newer one compiles for more processors."""
    version = [-int(number) for number in re.findall(r"\d+", info.driver)[:3]]
    return _PREFERENCE.index(info.kind), -info.compute_units, "Intel" not in info.platform, version


def _log_choice(device: Device, name: object, trial: Trial) -> None:
    info = device.info
    log.debug("OpenCL device: %s%s", info, f", {device.lanes} lanes" if device.lanes > 1 else "")
    if trial.fault:
        log.debug("it works with %d lanes, not with more: %s", device.lanes, trial.fault)
    if _requested(name)[0].strip().lower() == "auto" and info.kind != "GPU":
        log.warning("no graphics card (GPU) was found that OpenCL can use: computing on the processor (%s), which is "
                    "many times slower; 'pagas-cl devices' shows what is missing", info.name.strip())
    else:
        log.info("computing on %s (%s)", info.name.strip(), info.kind)
