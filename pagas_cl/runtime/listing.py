"""Which devices OpenCL offers, listed first by a child process: a driver that crashes there is left out here."""

import os
from functools import cache as cached
from pathlib import Path
from typing import Any

from pagas_cl.errors import NoDeviceError, log
from pagas_cl.runtime import cache, vendors
from pagas_cl.runtime.info import DeviceInfo, describe
from pagas_cl.system.child import ask, end_with_parent

LIMIT = 60.0              # seconds for the drivers to say what they have


def find_devices(cl: Any) -> list[tuple[DeviceInfo, Any]]:
    """As enumerate_devices, without the drivers that crash or hang when they list their devices."""
    with vendors.registered(), vendors.setting(usable_drivers()):
        return enumerate_devices(cl)


def usable_drivers() -> str | None:
    """What OCL_ICD_VENDORS has to be to leave out the drivers that crash or hang when a child process lists their
    devices; None where none does. NoDeviceError where those that are left crash, too."""
    return _usable(cache.digest(os.environ.get(vendors.VARIABLE, ""), [_state(name) for name in vendors.icd_files()]))


@cached
def _usable(key: str) -> str | None:
    """The same for the set of drivers called `key`, found out once for each set."""
    found = cache.read("drivers", key)
    if found is None:
        found = _surviving() if _falls() else {"left_out": [], "vendors": None}
        if found["vendors"] != "" or vendors.icd_files():      # without such files no key says which drivers they were
            cache.write("drivers", key, found)
    if found["vendors"] == "":
        raise NoDeviceError("every OpenCL driver here crashes or hangs when it lists its devices "
                            f"({', '.join(vendors.icd_files())}): remove or update them. {vendors.cpu_advice()}")
    if found["vendors"]:
        log.warning("OpenCL drivers that crash or hang when they list their devices are left out: %s",
                    ", ".join(found["left_out"]))
    chosen: str | None = found["vendors"]
    return chosen


def _surviving() -> dict[str, Any]:
    """The drivers that crash when they are loaded alone, and what OCL_ICD_VENDORS has to be for all others, or at least
    for one of them; empty where none is left."""
    alone = {name: not _falls({vendors.VARIABLE: name}) for name in vendors.icd_files()}
    well = [name for name, survives in alone.items() if survives]
    for choice in ((vendors.folder_of(well), *well) if well else ()):      # a loader may have more drivers
        if not _falls({vendors.VARIABLE: choice}):
            return {"left_out": [name for name in alone if name not in well] or ["those next to " + choice],
                    "vendors": choice}
    return {"left_out": list(alone), "vendors": ""}


def _falls(environment: dict[str, str] | None = None) -> bool:
    """Whether listing their devices ends or stops a process."""
    answer = ask(__name__, {}, LIMIT, environment)
    return answer.hung or answer.crashed


def _state(name: str) -> list[Any]:
    """What distinguishes an .icd file and its library from those of another version."""
    text = Path(name).read_text(errors="replace").strip()
    library = Path(text)
    found = library.stat() if library.is_absolute() and library.is_file() else None
    return [name, text, found and [found.st_size, found.st_mtime_ns]]


def enumerate_devices(cl: Any) -> list[tuple[DeviceInfo, Any]]:
    """Every device of every platform, in the platforms' order, as (DeviceInfo, pyopencl.Device), listed in this
    process; NoDeviceError where the loader finds no platform, or the platforms have no device."""
    vendors.begin_process()
    try:
        platforms = cl.get_platforms()
    except cl.Error as error:
        raise NoDeviceError(vendors.no_platform(str(error))) from error
    if not platforms:
        raise NoDeviceError(vendors.no_platform())
    found: list[tuple[DeviceInfo, Any]] = []
    for platform in platforms:
        try:
            devices = platform.get_devices()
        except cl.Error as error:
            log.warning("OpenCL platform %s: its devices cannot be listed: %s", platform.name, error)
            continue
        found += [(describe(cl, platform, device), device) for device in devices]
    if not found:
        raise NoDeviceError(vendors.no_device([platform.name.strip() for platform in platforms]))
    return found


if __name__ == "__main__":
    end_with_parent()
    enumerate_devices(vendors.import_pyopencl())
