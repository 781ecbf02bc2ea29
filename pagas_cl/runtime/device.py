"""Choosing an OpenCL device and opening it: one context, one in-order queue."""

import os
import re
import threading
import weakref
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeAlias

from pagas_cl.errors import DeviceError, DeviceLostError, DeviceMemoryError, NoDeviceError, log
from pagas_cl.runtime import icd, listing
from pagas_cl.runtime.host import keep_freed
from pagas_cl.runtime.info import DeviceInfo, number_in
from pagas_cl.runtime.trial import Trial, try_device
from pagas_cl.runtime.vendors import check_process, import_pyopencl

if TYPE_CHECKING:
    from pagas_cl.runtime.allocations import Memory

ENVIRONMENT = "PAGAS_CL_DEVICE"
SHARE = "PAGAS_CL_SHARE"  # how many processes may work on one device
SPARE = 1 / 8             # of a device's own memory: buffers that wait may take it, beyond what is planned
_told: set[DeviceInfo] = set()
_PREFERENCE = ("GPU", "accelerator", "CPU", "other")


@dataclass(frozen=True, eq=False)
class Device:
    """An open device: what it is, its context, and one in-order queue."""

    info: DeviceInfo
    cl_device: Any
    context: Any
    queue: Any
    lanes: int = 1
    """Pixels of a row that a work-item handles side by side: the most that have been seen to work here."""
    profiling: bool = False
    """Whether events of `queue` carry times."""

    @cached_property
    def memory(self) -> "Memory":
        """The buffers that this process holds on the device, counted."""
        from pagas_cl.runtime.allocations import Memory, limit_of

        spare = 0 if self.info.kind == "CPU" else SPARE      # there it is the host's memory, and soon freed
        return Memory(self.info.title, limit_of(self.info.memory, shares()), spare)

    def has(self, extension: str) -> bool:
        """Whether the device reports the OpenCL `extension`."""
        return extension in self.info.extensions


# One device, by its name or open, or several, by a list of names or "all".
Devices: TypeAlias = str | Device | list[str] | tuple[str, ...]


def open_device(name: str | Device | None = None, *, profiling: bool = False) -> Device:
    """Open the OpenCL device called `name`, if a trial has shown that it works (runtime.trial; made once a driver).

    `name` is part of "platform / device", upper or lower case; "gpu" or "cpu" for the kind; "auto" for the best one (a
    GPU before a CPU). None takes the environment variable PAGAS_CL_DEVICE, and "auto" where it is not set. A Device is
    returned as it is. `profiling`: record a start and an end time with every event of the queue.

    DeviceError: there is no platform, no device matches, the one that matches lacks something, has failed its trial, or
    cannot be opened. The message says what was found and what to install.
    """
    if isinstance(name, Device):
        check_process()
        return name
    cl, faults = import_pyopencl(), []
    for info, cl_device in candidates(find_devices(cl), name):
        trial = try_device(info)
        try:
            device = trial.lanes and (_still_open(cl, cl_device, profiling)
                                      or _keep(opened(info, cl_device, trial.lanes, profiling)))
        except cl.Error as error:
            device, trial = None, replace(trial, fault=cause(error))
        if device:
            _tell(device, name, trial)
            return device
        faults.append(f"{info}: {trial.fault}")
        log.warning("OpenCL device %s does not work and is not used: %s", info, trial.fault)
    raise DeviceError(f"no OpenCL device that matches works: {'; '.join(faults)}. Is it in use by another process, or "
                      "its driver older than the hardware ('pagas-cl devices --again' tries anew)? Choose another "
                      f"with device= or {ENVIRONMENT}. {icd.cpu_advice()}")


# Devices that this thread has open: a context of its own for every call would keep its programs, 20 MB, for ever.
_kept = threading.local()


def _keep(device: Device) -> Device:
    if hasattr(device.cl_device, "int_ptr"):
        vars(_kept)[f"{os.getpid()} {device.cl_device.int_ptr} {device.profiling}"] = device
    return device


def _still_open(cl: Any, cl_device: Any, profiling: bool) -> Device | None:
    """The device as this thread has opened it before, if it still answers."""
    key = f"{os.getpid()} {getattr(cl_device, 'int_ptr', None)} {profiling}"
    device: Device | None = vars(_kept).get(key)
    if device is not None:
        try:
            cl.enqueue_marker(device.queue).wait()
        except cl.Error:       # lost, or reset: another context may do
            give_up(device)
        if device in _given_up:
            del vars(_kept)[key]
            return None
    return device


_given_up: weakref.WeakSet[Device] = weakref.WeakSet()


def give_up(device: Device) -> None:
    """Never use this context again: what it is asked for may fail or come out wrong."""
    _given_up.add(device)


def working(device: Device) -> Device:
    """`device`, or the same one opened anew where its context was given up; DeviceError where it cannot be."""
    check_process()
    if device not in _given_up:
        return device
    try:
        return _keep(opened(device.info, device.cl_device, device.lanes, device.profiling))
    except import_pyopencl().Error as error:
        raise DeviceError(f"{device.info.title} has failed and cannot be opened again ({cause(error)}): finished views "
                          "are kept, start the same command again or choose another device with "
                          f"{ENVIRONMENT}") from error


def is_elsewhere(executor: Any, devices: Any) -> bool:
    """Whether these arguments of refine_views ask for other processes than this one."""
    return executor is not None or devices == "all" or isinstance(devices, (list, tuple))


def one_of(devices: Any) -> Any:
    """The device to work on in this process, by name or open, of what refine_views takes: the first of several."""
    if isinstance(devices, (list, tuple)):
        devices = devices[0] if devices else None
    return None if isinstance(devices, str) and devices == "all" else devices


def opened(info: DeviceInfo, cl_device: Any, lanes: int, profiling: bool = False) -> Device:
    """Open one device of `find_devices` with the `lanes` that it is known to work with; a pyopencl error where it
    cannot be opened."""
    cl = import_pyopencl()
    context = cl.Context([cl_device])
    device = Device(info, cl_device, context, _queue(context, cl_device, profiling), lanes, profiling)
    keep_freed(info.kind != "CPU")       # which shares the host's memory
    device.memory      # noqa: B018  (InputError where PAGAS_CL_MEMORY is no number: now, and not in the first view)
    return device


def _queue(context: Any, cl_device: Any, profiling: bool) -> Any:
    cl = import_pyopencl()
    return cl.CommandQueue(context, cl_device, cl.command_queue_properties.PROFILING_ENABLE if profiling else 0)


# What the driver says when a device fails in the middle of work.
_MEMORY = ("MEM_OBJECT_ALLOCATION_FAILURE", "OUT_OF_HOST_MEMORY")
_LOST = ("OUT_OF_RESOURCES", "DEVICE_NOT_AVAILABLE", "DEVICE_NOT_FOUND", "INVALID_DEVICE", "INVALID_COMMAND_QUEUE",
         "INVALID_CONTEXT", "EXEC_STATUS_ERROR_FOR_EVENTS_IN_WAIT_LIST")
_OF_DRIVERS = -9999       # NVIDIA's code for an access that its hardware refused; below -1000 each maker has its own


@contextmanager
def translate_cl_errors(device: Device, doing: str) -> Iterator[None]:
    """Context: errors of the driver while `doing` (a noun phrase) on `device`, as ours; others as they are.

    DeviceMemoryError: it has no memory left, fewer buffers may do. DeviceLostError: it answers no more, or has ended
    what it was at; its context is given up.
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
            give_up(device)
            raise DeviceLostError(f"{title} failed during {doing} ({error}): start the same command again, which goes "
                                  "on from the views that are on disk; where it fails again, update its driver or "
                                  "choose another device (pagas-cl devices)") from error
        raise


def shares() -> int:
    """How many processes may work on one device."""
    return int(number_in(SHARE, "1", "a whole number of at least 1", lambda n: n >= 1 and n % 1 == 0))


def find_devices(cl: Any) -> list[tuple[DeviceInfo, Any]]:
    """As listing.enumerate_devices, of the drivers that survive being asked."""
    listing.check_drivers()
    return listing.enumerate_devices(cl)


def _asked(name: object) -> tuple[str, str]:
    """What device was asked for, and by what: the argument or the environment variable."""
    if name is None:
        return os.environ.get(ENVIRONMENT) or "auto", ENVIRONMENT
    return str(name), "device"


def cause(error: Exception) -> str:
    """The line of an OpenCL error that says what is wrong."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return next((line for line in lines if line.startswith("error:")), lines[0] if lines else repr(error))


def candidates(found: Iterable[tuple[DeviceInfo, Any]], name: object) -> list[tuple[DeviceInfo, Any]]:
    """The (DeviceInfo, device) pairs of `found` that `name` means, best first; see open_device."""
    asked, source = _asked(name)
    wanted = asked.strip().lower()
    matching = [pair for pair in found if wanted in ("auto", pair[0].kind.lower())
                or wanted in pair[0].title.lower()]
    if not matching:
        names = "; ".join(info.title for info, _ in found)
        raise NoDeviceError(f"no OpenCL device matches {source}={asked!r}; found: {names}")
    usable = [pair for pair in matching if not pair[0].lacks]
    if not usable:
        reasons = "; ".join(f"{info.title} lacks {', '.join(info.lacks)}" for info, _ in matching)
        raise NoDeviceError(f"no usable OpenCL device: {reasons}. {icd.cpu_advice()}")
    return sorted(usable, key=lambda pair: _rank(pair[0]))


def _rank(info: DeviceInfo) -> tuple[int, int, bool, list[int]]:
    """Smaller is better. Of two drivers for one processor Intel's is a quarter to a half faster than PoCL; of two PoCL
    the newer one compiles for more processors."""
    version = [-int(number) for number in re.findall(r"\d+", info.driver)[:3]]
    return _PREFERENCE.index(info.kind), -info.compute_units, "Intel" not in info.platform, version


def _tell(device: Device, name: object, trial: Trial) -> None:
    """Log the choice, once a process for each device: one run may open it for every view."""
    info = device.info
    if info in _told:
        return
    _told.add(info)
    log.debug("OpenCL device: %s%s", info, f", {device.lanes} lanes" if device.lanes > 1 else "")
    if trial.fault:
        log.debug("it works with %d lanes, not with more: %s", device.lanes, trial.fault)
    if _asked(name)[0].strip().lower() == "auto" and info.kind != "GPU":
        log.warning("no graphics card (GPU) was found that OpenCL can use: computing on the processor (%s), which is "
                    "many times slower; 'pagas-cl devices' shows what is missing", info.name.strip())
    else:
        log.info("computing on %s (%s)", info.name.strip(), info.kind)
