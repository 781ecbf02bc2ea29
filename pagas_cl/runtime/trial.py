"""Whether a device does what it says: a whole step of the refinement, built and run on it by a process of its own.

A driver may list a processor that its compiler does not know, abort while it compiles, never end, or compute another
number. What a trial has shown is kept on disk (device, driver, kernels, lanes), so that it is made once.
"""

import hashlib
import os
import time
from dataclasses import asdict, dataclass
from functools import cache as cached
from importlib.resources import files
from typing import Any

from pagas_cl.errors import log
from pagas_cl.runtime import cache
from pagas_cl.runtime.info import DeviceInfo, number_in
from pagas_cl.system import child

LANES, LIMIT, KNOWN = "PAGAS_CL_LANES", "PAGAS_CL_TRIAL_SECONDS", "PAGAS_CL_TRIAL"
WIDTHS = (16, 8, 4, 1)    # pixels of a row that a work-item may handle side by side (lanes.clh)
_NO_PROGRAM = '" doesn\'t exist'    # clang, as PoCL links with it, of a program that is not in PATH
MODULE = "pagas_cl.app.device_check"    # what the child runs: one step of each blend against a recorded gradient


@dataclass(frozen=True)
class Trial:
    """What trying a device has shown, in `seconds`."""

    lanes: int              # most pixels side by side with which it passed; 0 where it did not pass at all
    fault: str = ""         # why it did not pass, or not with more lanes; empty where nothing was wrong
    seconds: float = 0.0


def try_device(info: DeviceInfo, again: bool = False) -> Trial:
    """What a trial of the device has shown: kept from before, or made now, as it is with `again` whatever was kept.

    InputError where PAGAS_CL_LANES or PAGAS_CL_TRIAL_SECONDS does not hold what it may.
    """
    most = min(int(number_in(LANES, "16", "16, 8, 4 or 1", WIDTHS.__contains__)), info.vector_width)
    widths = tuple(width for width in WIDTHS if width <= max(1, most))
    limit = number_in(LIMIT, "180", "seconds above 0", lambda seconds: 0 < seconds < 1e6)
    key = cache.digest(identity(info), widths)
    kept = None if again else _trial(cache.read("devices", key))
    if kept:
        return kept
    log.info("first run on %s: its driver is tested, which takes some seconds, once", info.title)
    start = time.monotonic()
    passed = 0
    faults = []
    lasting, hung = True, False
    for lanes in widths:
        if hung and lanes != widths[-1]:        # a compiler that does not end is given the easiest task at once
            continue
        answer = child.ask(MODULE, {"identity": identity(info), "lanes": lanes}, limit)
        found = answer.value or {"fault": f"its driver {answer.fault}", "lasting": _NO_PROGRAM not in answer.fault}
        if not found["fault"]:
            passed = lanes
            break
        faults.append((lanes, found["fault"]))
        lasting, hung = found["lasting"], answer.hung
    trial = Trial(passed, _clause(faults), round(time.monotonic() - start, 1))
    if lasting:      # a device that was busy, or whose linker PATH lacked, may do the next time
        cache.write("devices", key, {**asdict(trial), "device": str(info), "kernels": kernels()})
    return trial


def identity(info: DeviceInfo) -> list[Any]:
    """What distinguishes one device and driver from another; two boards of one kind are the same."""
    return [info.platform, info.name, info.vendor, info.version, info.c_version, info.driver, *info.extensions]


@cached
def kernels() -> str:
    """A hash of the kernels of this version and of the numbers that they are built with."""
    sources = [file for file in files("pagas_cl.cl_kernels").iterdir() if file.name.endswith((".cl", ".clh"))]
    sources += [files("pagas_cl.method.splat").joinpath(name) for name in ("constants.py", "options.py")]
    text = sorted((file.name, file.read_bytes()) for file in sources)
    return hashlib.sha256(repr(text).encode()).hexdigest()[:24]


def _trial(kept: dict[str, Any] | None) -> Trial | None:
    """The trial that a file holds, if it is one of these kernels; with PAGAS_CL_TRIAL=known, of any that passed."""
    known = os.environ.get(KNOWN) == "known"
    if not kept or (kept.get("kernels") != kernels() and not (known and kept.get("lanes"))):
        return None
    try:
        return Trial(int(kept["lanes"]), str(kept["fault"]), float(kept["seconds"]))
    except (KeyError, TypeError, ValueError):
        return None


def _clause(faults: list[tuple[int, str]]) -> str:
    """One clause from (lanes, fault) pairs, the same fault named once."""
    by_fault: dict[str, list[str]] = {}
    for lanes, fault in faults:
        by_fault.setdefault(fault, []).append(str(lanes))
    return "; ".join(f"with {', '.join(lanes[:-1])}{' and ' * (len(lanes) > 1)}{lanes[-1]} "
                     f"lane{'s' * (lanes != ['1'])} {fault}" for fault, lanes in by_fault.items())
