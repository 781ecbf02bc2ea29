"""Kernels from package data: includes pasted, compiled once a device and defines, launched with bound arguments."""

import re
import warnings
import weakref
from collections import defaultdict, deque
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from types import MappingProxyType
from typing import Any

import numpy as np
import pyopencl as cl

from pagas_cl.errors import DeviceError, KernelBuildError
from pagas_cl.runtime.binaries import compiled
from pagas_cl.runtime.device import Device, cause

COMMON = "common.cl"
_INCLUDE = re.compile(r'^#include "([\w.]+)"$')
GROUP_1D, GROUP_2D = (128,), (32, 4)
OPTIONS = ("-cl-std=CL1.2", "-cl-mad-enable", "-cl-single-precision-constant", "-cl-denorms-are-zero",
           "-w")     # warnings: nobody reads them
_NO_BUFFER = np.intp(0)      # a null pointer, which the versions of pyopencl of two years do not make of None


@cache
def source(name: str) -> str:
    """Text of the kernel file `name` with its includes pasted in, #line marks keeping the compiler's messages true."""
    return "\n".join(_pasted(name, set()))


def _pasted(name: str, seen: set[str]) -> list[str]:
    if name in seen:
        return []
    seen.add(name)
    lines = [f'#line 1 "{name}"']
    for number, line in enumerate(files("pagas_cl.cl_kernels").joinpath(name).read_text("utf-8").splitlines(), start=1):
        included = _INCLUDE.match(line)
        if included:
            lines += _pasted(included[1], seen) + [f'#line {number + 1} "{name}"']
        else:
            lines.append(line)
    return lines


@cache
def _compiled_with(name: str) -> str:
    """The file that is compiled where the kernel file `name` is requested: COMMON, if that includes it."""
    seen: set[str] = set()
    _pasted(COMMON, seen)
    return COMMON if name in seen else name


@cache
def _mentioned(name: str, defines: tuple[str, ...]) -> tuple[str, ...]:
    identifiers = set(re.findall(r"\w+", _COMMENT.sub("", source(name))))
    return tuple(define for define in defines if define.partition("=")[0] in identifiers)


_KERNEL = re.compile(r"__kernel\b[^;{]*?\bvoid\s+(\w+)\s*\(([^)]*)\)")
_COMMENT = re.compile(r"//[^\n]*|/\*.*?\*/", re.DOTALL)


@dataclass(frozen=True, eq=False)
class Program:
    built: cl.Program
    signatures: dict[str, dict[str, str]]
    """Of each kernel: the names of its arguments, in order, and "int", "float", or "" for a buffer."""
    queue: cl.CommandQueue
    idle: "defaultdict[str, deque[Launch]]" = field(default_factory=lambda: defaultdict(deque))
    """By name, kernels that wait for arguments: making one takes ten times as long as setting its arguments. The one
    that has waited longest goes first, so that each comes back to the view that it served."""

    def run(self, name: str, global_size: Sequence[int], local_size: Sequence[int] | None = None,
            known: Mapping[str, Any] = MappingProxyType({}), /, **arguments: Any) -> None:
        """Enqueue the kernel `name` once, on the device that this was compiled for; arguments as in `bind`."""
        run_once(self.queue, [bind(self, name, global_size, local_size, known, **arguments)])


def signatures(text: str) -> dict[str, dict[str, str]]:
    """As in Program, of every kernel in the source `text`: not every driver reports them."""
    return {name: dict(map(_parameter, parameters.split(",")))
            for name, parameters in _KERNEL.findall(_COMMENT.sub("", text))}


def _parameter(declaration: str) -> tuple[str, str]:
    *_, kind, name = re.findall(r"\w+", declaration)
    return name, "" if "*" in declaration else kind


def build(device: Device, name: str, defines: tuple[str, ...] = ()) -> Program:
    """Compile the kernel file `name`, or COMMON with what it includes, for `device` with those of `defines` ("NAME" or
    "NAME=value") that it mentions; once a device: what a file does not mention must not make another program of it."""
    name = _compiled_with(name)
    defines = _mentioned(name, defines)
    key = name, defines, device.queue
    if key not in device.programs:
        options = [*OPTIONS, *(f"-D{define}" for define in defines)]
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", cl.CompilerWarning)
                built = compiled(device, source(name), options)
        except cl.RuntimeError as error:
            raise KernelBuildError(f"{name} does not compile on {device.info.title}: {cause(error)}; "
                                   "update the driver, or choose another device (pagas-cl devices)",
                                   log=str(error), options=" ".join(options), source=source(name)) from error
        device.programs[key] = Program(built, signatures(source(name)), device.queue)
    program: Program = device.programs[key]
    return program


class Launch:
    """A kernel with its arguments set by name, ready to be enqueued any number of times; see `bind`."""

    def __init__(self, program: Program, name: str):
        self.cl_kernel = cl.Kernel(program.built, name)
        self.stage = name
        self.places = {argument: (index, kind) for index, (argument, kind) in
                       enumerate(program.signatures[name].items())}
        self.global_size: tuple[int, ...] = ()
        self.local_size: tuple[int, ...] | None = None
        self._idle = weakref.ref(program.idle[name])       # no circle: a context that is lost is to go at once
        # set_arg takes a number for four other things first, by exceptions: 10 us each, more than a launch
        self._set_number = getattr(self.cl_kernel, "_set_arg_buf", self.cl_kernel.set_arg)
        self._numbers: dict[str, Any] = {}
        self._buffers: dict[str, weakref.ref[Any]] = {}     # the driver is to have one back that nobody else holds

    def set(self, **values: Any) -> None:
        """Other values for some arguments, by name: what is the same stays."""
        for name, value in values.items():
            index, kind = self.places[name]
            if kind:
                if self._numbers.get(name) != value:
                    self._set_number(index, _number(value, kind, self.stage))
                    self._numbers[name] = value
            elif value is None or name not in self._buffers or self._buffers[name]() is not value:
                self.cl_kernel.set_arg(index, _NO_BUFFER if value is None else value)
                self._buffers.pop(name, None)
                with suppress(TypeError):       # there are weak references to most
                    self._buffers[name] = weakref.ref(value)

    def change(self, **values: Any) -> None:
        """The same, of those arguments that the kernel has."""
        self.set(**{name: value for name, value in values.items() if name in self.places})

    def enqueue(self, queue: cl.CommandQueue) -> cl.Event:
        return cl.enqueue_nd_range_kernel(queue, self.cl_kernel, self.global_size, self.local_size)

    def release(self) -> None:
        """Give the kernel back for other arguments; what is enqueued keeps those that it was enqueued with."""
        idle = self._idle()
        if idle is not None:
            idle.append(self)


def _number(value: Any, kind: str, name: str) -> np.generic:
    if kind == "float":
        return np.float32(value)
    # NumPy 1 would wrap it, and OpenCL refuse one of 64 bits without saying which
    if not -2**31 <= value < 2**31:
        raise DeviceError(f"kernel {name} was given {value}, expected a whole number of 32 bits (-2147483648 to "
                          "2147483647)")
    return np.int32(value)


class _Transfer:
    """What a queue is given that is no kernel; `stage` is what its time is counted as."""

    def change(self, **values: Any) -> None:
        """It has no arguments."""

    def release(self) -> None:
        """Nothing is held."""


@dataclass(frozen=True)
class Fill(_Transfer):
    """A buffer to be filled with one number."""

    buffer: cl.Buffer
    pattern: np.generic
    size: int
    stage: str = "fill"

    def enqueue(self, queue: cl.CommandQueue) -> cl.Event:
        pattern: Any = self.pattern  # a NumPy scalar is a buffer, which NumPy's types do not say
        return cl.enqueue_fill_buffer(queue, self.buffer, pattern, 0, self.size)


@dataclass(frozen=True)
class Upload(_Transfer):
    """An array of the host to be copied into a buffer."""

    buffer: cl.Buffer
    array: np.ndarray
    stage: str = "upload"

    def enqueue(self, queue: cl.CommandQueue) -> cl.Event:
        return cl.enqueue_copy(queue, self.buffer, self.array, is_blocking=False)


def run_once(queue: cl.CommandQueue, launches: Iterable[Launch | Fill | Upload]) -> None:
    """Enqueue `launches` in order and release them."""
    for launch in launches:
        launch.enqueue(queue)
        launch.release()


def bind(program: Program, name: str, global_size: Sequence[int], local_size: Sequence[int] | None = None,
         known: Mapping[str, Any] = MappingProxyType({}), /, **arguments: Any) -> Launch:
    """A Launch of `name` with its own argument set, each argument by the name that the kernel has for it.

    Work-items are rounded up to whole groups of `local_size` (GROUP_2D or GROUP_1D by default; a single item stays
    alone), so that every kernel looks where its data ends. Arguments that are not given are looked up in `known`; each
    is a Buffer, None (a null buffer), or a number, which is converted to the kernel's type.

    DeviceError where a whole number does not fit into 32 bits; TypeError where an argument is missing, or unknown.
    """
    signature = program.signatures[name]
    values = {**known, **arguments} if arguments else known
    if not (arguments.keys() <= signature.keys() <= values.keys()):
        missing = signature.keys() - values.keys()
        unknown = arguments.keys() - signature
        raise TypeError(f"kernel {name} takes {', '.join(signature)}: missing {sorted(missing)}, unknown "
                        f"{sorted(unknown)}")
    idle = program.idle[name]
    launch = idle.popleft() if idle else Launch(program, name)
    launch.set(**{argument: values[argument] for argument in signature})
    group: tuple[int, ...] | None = GROUP_2D if len(global_size) == 2 else GROUP_1D if global_size[0] > 1 else None
    if local_size:      # else not left to the driver, of which a prime width gets groups of one
        group = tuple(local_size)
    if group:
        global_size = [-(-items // side) * side for items, side in zip(global_size, group)]
    launch.global_size, launch.local_size = tuple(int(items) for items in global_size), group
    return launch
