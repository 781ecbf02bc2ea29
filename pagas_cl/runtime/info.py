"""What an OpenCL device says of itself, and what it lacks."""

import math
import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from pagas_cl.errors import InputError

WITHOUT = "PAGAS_CL_WITHOUT"   # extensions to be taken for absent, with commas between them
LOCAL_MEMORY = 32 * 1024   # bytes of local memory that a work-group of the kernels may use; OpenCL grants as many
WORK_GROUP = 64            # least work-items of a group that a device must allow


@dataclass(frozen=True)
class DeviceInfo:
    """What one OpenCL device says of itself. Sizes are in bytes."""

    platform: str
    name: str
    kind: str                   # one of "GPU", "CPU", "accelerator" and "other"
    vendor: str = ""
    version: str = ""           # the device's OpenCL version
    c_version: str = ""         # that of its compiler
    driver: str = ""
    memory: int = 0
    max_alloc: int = 0          # the largest single buffer
    local_memory: int = 0       # of a work-group
    work_group: int = 1
    compute_units: int = 1
    vector_width: int = 1       # floats in one instruction of its processor, as the driver has it; 1 on a GPU
    extensions: tuple[str, ...] = ()
    available: bool = True
    compiler: bool = True
    little_endian: bool = True

    @property
    def title(self) -> str:
        """What a device name is matched against: "platform / device"."""
        return f"{self.platform} / {self.name}"

    @property
    def lacks(self) -> tuple[str, ...]:
        """What the kernels need and this device has not; empty for a usable device."""
        faults = (
            (not self.available, "it is not available"),
            (not self.compiler, "a compiler"),
            (not self.little_endian, "little-endian byte order"),
            (_c_version(self.c_version) < (1, 2), f"OpenCL C 1.2 (it has {self.c_version.strip() or 'none'})"),
            (self.local_memory < LOCAL_MEMORY, f"{LOCAL_MEMORY // 1024} kB of local memory"),
            (self.work_group < WORK_GROUP, f"work-groups of {WORK_GROUP} (it allows {self.work_group})"),
        )
        return tuple(text for fault, text in faults if fault)

    @property
    def does_without(self) -> tuple[str, ...]:
        """What is absent and not needed: the kernels have a slower way round it, or never use it."""
        wanted = (("cl_khr_int64_base_atomics", "64-bit atomics (32-bit pairs are used)"),
                  ("cl_khr_fp64", "fp64 (not used)"))
        return tuple(text for extension, text in wanted if extension not in self.extensions)

    def __str__(self) -> str:
        return f"{self.title} ({self.kind}, {self.version.strip()}, driver {self.driver.strip()})"


def number_in(variable: str, usual: str, expected: str, holds: Callable[[float], bool]) -> float:
    """The number in an environment `variable`, or `usual`; InputError, with `expected`, unless it `holds`."""
    text = os.environ.get(variable, usual)
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not holds(number):
        raise InputError(f"environment variable {variable} is {text!r}, expected {expected}")
    return number


def describe(cl: Any, platform: Any, device: Any) -> DeviceInfo:
    kinds = ((cl.device_type.GPU, "GPU"), (cl.device_type.CPU, "CPU"), (cl.device_type.ACCELERATOR, "accelerator"))
    without = {word.strip() for word in os.environ.get(WITHOUT, "").split(",")}
    return DeviceInfo(
        platform=platform.name.strip(), name=device.name.strip(), vendor=device.vendor.strip(),
        kind=next((kind for bit, kind in kinds if device.type & bit), "other"),
        version=device.version.strip(), c_version=device.opencl_c_version.strip(),
        driver=device.driver_version.strip(), memory=int(device.global_mem_size),
        max_alloc=int(device.max_mem_alloc_size), local_memory=int(device.local_mem_size),
        work_group=int(device.max_work_group_size), compute_units=int(device.max_compute_units),
        vector_width=int(device.native_vector_width_float),
        extensions=tuple(word for word in device.extensions.split() if word not in without),
        available=bool(device.available), compiler=bool(device.compiler_available),
        little_endian=bool(device.endian_little))


def _c_version(text: str) -> tuple[int, int]:
    """(1, 2) from "OpenCL C 1.2 PoCL"; (0, 0) from what cannot be read."""
    found = re.search(r"(?:^|\s)(\d+)\.(\d)", text, re.ASCII)
    return (int(found[1]), int(found[2])) if found else (0, 0)
