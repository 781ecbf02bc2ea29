"""Device buffers declared as data: planned, compared with the device and allocated from one declaration."""

from collections.abc import Iterable
from dataclasses import Field, dataclass, field, fields
from math import prod
from typing import Any, TypeVar

import numpy as np
import pyopencl as cl

from pagas_cl.errors import DeviceError, DeviceMemoryError
from pagas_cl.runtime.device import Device
from pagas_cl.runtime.memory import release

Handed = TypeVar("Handed", bound="Buffers")

MOST_ELEMENTS = 2**31 - 1         # kernels count in 32 bits


@dataclass(frozen=True)
class BufferSpec:
    name: str
    shape: tuple[int, ...]
    dtype: type

    @property
    def nbytes(self) -> int:
        return max(1, prod(self.shape)) * np.dtype(self.dtype).itemsize


def total_bytes(specs: Iterable[BufferSpec]) -> int:
    return sum(spec.nbytes for spec in specs)


def allocate(device: Device, specs: list[BufferSpec]) -> dict[str, cl.Buffer]:
    """Buffers for `specs`, by name.

    DeviceError before anything is allocated, where one is larger than the device or the kernels can handle;
    DeviceMemoryError where they are more than may be held, or the device refuses one: none is kept then.
    """
    largest = max(specs, key=lambda spec: spec.nbytes)
    limit = device.info.max_alloc
    if max(prod(spec.shape) for spec in specs) > MOST_ELEMENTS:
        raise DeviceError("a buffer needs more than 2^31 elements, which the kernels cannot count: refine smaller "
                          "images, or with a smaller splatting.radius")
    if largest.nbytes > limit:
        raise DeviceError(f"buffer {largest.name!r} needs {largest.nbytes / 2**20:.0f} MiB, {device.info.title} "
                          f"allocates at most {limit / 2**20:.0f} MiB at once; refine smaller images")
    made: dict[str, cl.Buffer] = {}
    try:
        for spec in specs:
            made[spec.name] = device.buffer(spec.nbytes, spec.name)
    except DeviceMemoryError:
        release(*made.values())
        raise
    return made


def declared(shape: tuple[int | str, ...], dtype: type, unit: str, purpose: str, needed: str = "",
             start: Any = None, each: str = "") -> Any:
    """A field of a Buffers class.

    A str in `shape` names one of the dimensions that a plan is made for; `unit` is that of an element, "" for none. The
    field is None where the dimension `needed` is zero or False, and a tuple of buffers where `each` names one that is a
    list: with so many elements each. `start`, a NumPy scalar of 32 bits, is what it is filled with when allocated.
    """
    return field(default=() if each else None, metadata=dict(
        shape=shape, dtype=dtype, unit=unit, purpose=purpose, needed=needed, start=start, each=each))


def _specs(own: Field[Any], dimensions: dict[str, Any]) -> list[BufferSpec]:
    rule = own.metadata
    if rule["needed"] and not dimensions[rule["needed"]]:
        return []
    shape = tuple(dimensions[part] if isinstance(part, str) else part for part in rule["shape"])
    if rule["each"]:
        return [BufferSpec(f"{own.name}{k}", (length, *shape), rule["dtype"])
                for k, length in enumerate(dimensions[rule["each"]])]
    return [BufferSpec(own.name, shape, rule["dtype"])]


@dataclass(eq=False)
class Buffers:
    """Buffers of one device, each a field, released together. A stage on its own needs those of its kernels alone."""

    @classmethod
    def plan(cls, dimensions: dict[str, Any]) -> list[BufferSpec]:
        """What is allocated for `dimensions`, by the names that the fields use."""
        return [spec for own in fields(cls) for spec in _specs(own, dimensions)]

    @classmethod
    def allocated(cls: type[Handed], device: Device, dimensions: dict[str, Any]) -> Handed:
        """All that is planned, on `device`; errors as of `allocate`."""
        planned = {own: _specs(own, dimensions) for own in fields(cls)}
        made = allocate(device, sum(planned.values(), []))
        found: dict[str, Any] = {}
        for own, specs in planned.items():
            buffers = tuple(made[spec.name] for spec in specs)
            if own.metadata["start"] is not None:
                for buffer in buffers:
                    cl.enqueue_fill_buffer(device.queue, buffer, own.metadata["start"], 0, buffer.size)
            found[own.name] = buffers if own.metadata["each"] else next(iter(buffers), None)
        return cls(**found)

    def hand_over(self, kind: type[Handed]) -> Handed:
        """The buffers of the class `kind`, the caller's from now on; the others are released."""
        taken = kind(**{own.name: self.take(own.name) for own in fields(kind)})
        self.release()
        return taken

    def take(self, name: str) -> cl.Buffer:
        """The buffer `name`, the caller's from now on."""
        buffer: cl.Buffer = getattr(self, name)
        setattr(self, name, None)
        return buffer

    def release(self) -> None:
        """Give all buffers back now instead of when Python gets to it."""
        release(*self.held())
        for own in fields(self):
            setattr(self, own.name, own.default)

    def held(self) -> list[cl.Buffer]:
        """The buffers that are not None or taken."""
        values = [getattr(self, own.name) for own in fields(self)]
        return [buffer for value in values for buffer in (value if isinstance(value, tuple) else (value,))
                if buffer is not None]
