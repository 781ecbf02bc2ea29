"""One worker process, one device: several processes of a machine take different devices, without talking.

Each process locks a file named after the device (its place on the bus where the driver reports it). The lock goes
with the process, however that ends, so that a new worker can take a lost one's place.
"""

import os
import re
import stat
import tempfile
import time
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

from pagas_cl.errors import DeviceError
from pagas_cl.runtime import device as devices
from pagas_cl.runtime.device import Device
from pagas_cl.runtime.info import DeviceInfo
from pagas_cl.runtime.listing import find_devices
from pagas_cl.runtime.trial import try_device
from pagas_cl.runtime.vendors import import_pyopencl
from pagas_cl.system import locks

WAIT = 20.0               # seconds to wait for a device that is at work for another process
_held: dict[str, int] = {}      # the locks of this (worker) process and their file descriptors, until `give_back`


def known_devices(names: str | Sequence[str] | None = None) -> list[tuple[DeviceInfo, Any, int]]:
    """(DeviceInfo, pyopencl.Device, lanes) of every device that `names` means and that works, best first.

    `names` are parts of device names. "all" and None mean every device of the best kind there is: all GPUs, or else the
    CPU (one, since several drivers may offer the same one); None heeds the environment variable PAGAS_CL_DEVICE first.
    """
    chosen: list[tuple[DeviceInfo, Any, int]] = []
    found = find_devices(import_pyopencl())
    listed = [names] if isinstance(names, str) else names or ()
    every = names is None or "all" in listed
    for name in ([None if names is None else "auto"] if every else listed):
        for pair in devices.candidates(found, name):
            if every and chosen and (pair[0].kind != chosen[0][0].kind or pair[0].kind == "CPU"):
                break       # a trial of those that are not wanted may take half a minute
            lanes = try_device(pair[0]).lanes
            if lanes and pair[1] not in [other for _, other, _ in chosen]:
                chosen.append((*pair, lanes))
    if not chosen:
        raise DeviceError(f"no OpenCL device of {names!r} works: see 'pagas-cl devices'")
    return chosen


def claim_device(names: str | Sequence[str] | Device | None = None) -> Device:
    """Open the first of `names` that no other process works on; wait a little for one to become free. DeviceError where
    all are taken, or cannot be opened. PAGAS_CL_SHARE=3 in the environment lets three processes share one."""
    if isinstance(names, Device):
        return devices.working(names)
    cl = import_pyopencl()
    share = devices.shares()
    known = known_devices(names)
    until = time.monotonic() + WAIT
    fault = ""
    while True:
        for slot, (place, (info, cl_device, lanes)) in product(range(share), enumerate(known)):
            name = f"{_identity(info, cl_device, place)}-{slot}"
            if _lock(name):
                try:
                    return devices.opened(info, cl_device, lanes)
                except cl.Error as error:
                    fault = f"{info.title} cannot be opened: {error}"
                    os.close(_held.pop(name))
        if time.monotonic() > until:
            break
        time.sleep(0.5)
    if fault:
        raise DeviceError(f"{fault}; see 'pagas-cl devices'")
    titles = ", ".join(info.title for info, *_ in known)
    raise DeviceError(f"every requested device ({titles}) is at work for another process; start one worker a device, "
                      f"or let several share one with {devices.SHARE}={share + 1}")


def give_back() -> None:
    """Let other processes have what this one has claimed."""
    while _held:
        os.close(_held.popitem()[1])


def _identity(info: DeviceInfo, cl_device: Any, place: int) -> str:
    """The same in every process of the machine, whichever devices it is allowed to see."""
    where = []
    for name in ("pci_domain_id_nv", "pci_bus_id_nv", "pci_slot_id_nv", "topology_amd"):
        try:
            where.append(str(getattr(cl_device, name)))
        except Exception:  # each driver has its own way to say that it does not know
            continue
    return re.sub(r"[^\w.-]+", "_", f"{info.title}-{'-'.join(where) or place}")


def _lock(name: str) -> bool:
    """Take the lock `name` for the life of this process. DeviceError where there is no place for it."""
    if name in _held:
        return True
    try:
        descriptor = locks.take(_lock_folder() / f"{name}.lock")
    except OSError as error:
        raise DeviceError(f"no device can be claimed, since {error.filename!r} cannot be opened "
                          f"({error.strerror or error}): set TMPDIR to a folder of your own") from error
    if descriptor is not None:
        _held[name] = descriptor
    return descriptor is not None


def _lock_folder() -> Path:
    """A folder for locks that no other user can put anything into."""
    user = os.getuid() if hasattr(os, "getuid") else None
    folder = Path(tempfile.gettempdir()) / f"pagas_cl-{user if user is not None else 'locks'}"
    folder.mkdir(mode=0o700, exist_ok=True)
    found = folder.lstat()
    if user is not None and not (stat.S_ISDIR(found.st_mode) and found.st_uid == user and not found.st_mode & 0o022):
        raise DeviceError(f"no device can be claimed, since the folder {str(folder)!r} for its locks is not yours "
                          "alone (another user's, a link, or open to others): remove it, or set TMPDIR to a folder of "
                          "your own")
    return folder
