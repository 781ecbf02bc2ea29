"""Kernels from package data: includes pasted, compiled once per device and defines, launched with bound arguments."""

from __future__ import annotations

import re
import warnings
import weakref
from collections import defaultdict, deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import pyopencl as cl

from pagas_cl.errors import DeviceError, KernelBuildError

if TYPE_CHECKING:
    from pagas_cl.runtime.device import Device

_INCLUDE = re.compile(r'^#include "([\w.]+)"$')
GROUP_1D, GROUP_2D = (128,), (32, 4)
OPTIONS = ("-cl-std=CL1.2", "-cl-mad-enable", "-cl-single-precision-constant", "-w")     # warnings: nobody reads them


@cache
def source(name: str) -> str:
    """Text of the kernel file `name` with its includes pasted in, #line marks keeping the compiler's messages true."""
    return "\n".join(_pasted(name, set()))


def _pasted(name: str, seen: set[str]) -> list[str]:
    if name in seen:
        return []
    seen.add(name)
    lines = [f'#line 1 "{name}"']
    for number, line in enumerate(files("pagas_cl.cl_kernels").joinpath(name).read_text().splitlines(), start=1):
        included = _INCLUDE.match(line)
        if included:
            lines += _pasted(included[1], seen) + [f'#line {number + 1} "{name}"']
        else:
            lines.append(line)
    return lines


_programs: dict[tuple[int, str, tuple[str, ...]], cl.Program] = {}


def build(device: Device, name: str, defines: tuple[str, ...] = ()) -> cl.Program:
    """Compile the kernel file `name` for `device` with `defines` ("NAME" or "NAME=value").

    Programs are kept for the life of the process; pyopencl keeps the binaries on disk, keyed by source, options,
    device and driver.
    """
    key = (device.context.int_ptr, name, tuple(defines))
    if key not in _programs:
        options = [*OPTIONS, *(f"-D{define}" for define in defines)]
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", cl.CompilerWarning)
                _programs[key] = cl.Program(device.context, source(name)).build(options)
        except cl.RuntimeError as error:
            raise KernelBuildError(f"{name} does not compile on {device.info.title}: {_first_line(str(error))}; "
                                   "update the driver, or choose another device (pagas-cl devices)",
                                   log=str(error), options=" ".join(options), source=source(name)) from error
    return _programs[key]


def _first_line(log: str) -> str:
    errors = [line.strip() for line in log.splitlines() if "error" in line.lower()]
    return errors[0] if errors else log.strip().splitlines()[0]


class _Kernel:
    """A kernel that remembers its arguments: most are the same view after view, and setting one costs as much as
    looking at ten."""

    def __init__(self, program: cl.Program, name: str):
        self.cl_kernel = cl.Kernel(program, name)
        self._arguments: list[Any] = []         # as _remembered tells them; none before the first time

    def set_args(self, arguments: Sequence[Any]) -> None:
        if not self._arguments:
            self.cl_kernel.set_args(*arguments)
            self._arguments = [_remembered(value) for value in arguments]
            return
        for index, value in enumerate(arguments):
            self.set_arg(index, value)

    def set_arg(self, index: int, value: Any) -> None:
        known, remembered = self._arguments[index], _remembered(value)
        if known is not remembered and known != remembered:      # the same object needs no comparison
            self.cl_kernel.set_arg(index, value)
            self._arguments[index] = remembered                  # not if it was refused


def _remembered(value: Any) -> Any:
    """What tells an argument from another one: the bits of a number; of a buffer, which must not be kept alive here,
    the very object. Equal to nothing where that cannot be told."""
    if isinstance(value, np.generic):
        return value.dtype, value.tobytes()
    try:
        return value if value is None else weakref.ref(value)
    except TypeError:
        return object()


class Work(Protocol):
    """What a queue is given: a launch, a fill or an upload."""

    @property
    def stage(self) -> str:
        """What its time is counted as."""

    def enqueue(self, queue: cl.CommandQueue) -> cl.Event:
        """Put it into the queue, any number of times."""

    def release(self) -> None:
        """It will not be enqueued again."""


@dataclass(frozen=True)
class Launch:
    """A kernel with its arguments bound, ready to be enqueued any number of times."""

    bound: _Kernel
    global_size: tuple[int, ...]
    local_size: tuple[int, ...] | None = None
    stage: str = ""
    source: tuple[int, str] = (0, "")

    @property
    def kernel(self) -> cl.Kernel:
        return self.bound.cl_kernel

    def set_arg(self, index: int, value: np.generic) -> None:
        """Another value for one argument."""
        self.bound.set_arg(index, value)

    def enqueue(self, queue: cl.CommandQueue) -> cl.Event:
        return cl.enqueue_nd_range_kernel(queue, self.bound.cl_kernel, self.global_size, self.local_size)

    def release(self) -> None:
        """Give the kernel back for other arguments; what is enqueued keeps those that it was enqueued with."""
        _idle[self.source].append(self.bound)


@dataclass(frozen=True)
class Fill:
    """A buffer to be filled with one 32-bit pattern."""

    buffer: cl.Buffer
    pattern: np.generic
    size: int
    stage: str = "clear"

    def enqueue(self, queue: cl.CommandQueue) -> cl.Event:
        pattern: Any = self.pattern  # a NumPy scalar is a buffer, which NumPy's types do not say
        return cl.enqueue_fill_buffer(queue, self.buffer, pattern, 0, self.size)

    def release(self) -> None:
        """Nothing is held."""


@dataclass(frozen=True)
class Upload:
    """An array of the host to be copied into a buffer."""

    buffer: cl.Buffer
    array: np.ndarray
    stage: str = "upload"

    def enqueue(self, queue: cl.CommandQueue) -> cl.Event:
        return cl.enqueue_copy(queue, self.buffer, self.array, is_blocking=False)

    def release(self) -> None:
        """Nothing is held."""


def run_once(queue: cl.CommandQueue, launches: Iterable[Work]) -> None:
    """Enqueue `launches` in order and release them."""
    for launch in launches:
        launch.enqueue(queue)
        launch.release()


# Kernels that wait for arguments, by (program, name): making one takes ten times as long as setting its arguments. The
# one that has waited longest goes first, so that each comes back to the view that it served.
_idle: defaultdict[tuple[int, str], deque[_Kernel]] = defaultdict(deque)


def usual_group(global_size: Sequence[int]) -> tuple[int, ...] | None:
    """Work-items of a group where a kernel does not mind: left to the driver, a prime width gets groups of one.

    Global sizes are rounded up to it, so that every such kernel looks where its data ends; a single item stays alone.
    """
    if len(global_size) == 2:
        return GROUP_2D
    return GROUP_1D if global_size[0] > 1 else None


def bind(program: cl.Program, name: str, global_size: Sequence[int], local_size: Sequence[int] | None,
         *arguments: Any) -> Launch:
    """A Launch of `name` with its own argument set: int -> int32, float -> float32, None -> a null buffer.

    Raises
    ------
    DeviceError
        A whole number does not fit into 32 bits.
    """
    values = [_argument(value, name) for value in arguments]
    source = (program.int_ptr, name)
    kernel = _idle[source].popleft() if _idle[source] else _Kernel(program, name)
    kernel.set_args(values)
    group = tuple(local_size) if local_size else usual_group(global_size)
    if group:
        global_size = [-(-items // side) * side for items, side in zip(global_size, group)]
    return Launch(kernel, tuple(int(items) for items in global_size), group, name, source)


def _argument(value: Any, name: str) -> Any:
    if isinstance(value, (int, np.integer)):
        # NumPy 1 would wrap it, and OpenCL refuse one of 64 bits without saying which
        if not -2**31 <= value < 2**31:
            raise DeviceError(f"kernel {name} was given {value}, expected a whole number of 32 bits (-2147483648 to "
                              "2147483647)")
        return np.int32(value)
    if isinstance(value, float):
        return np.float32(value)
    return value
