"""Too little memory on the device is said before anything runs, and nothing stays behind."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pyopencl as cl
import pytest

from pagas_cl.errors import DeviceError
from pagas_cl.runtime import arena
from pagas_cl.runtime.arena import Arena, BufferSpec

INFO = dict(title="a device", max_alloc=2**30, memory=2**32)


def device(**info):
    return SimpleNamespace(info=SimpleNamespace(**{**INFO, **info}), context=None)


@pytest.mark.parametrize("info, shape, sentence", [
    ({}, (2**29,), "'depth' needs 2048 MiB, a device allocates at most 1024 MiB at once"),
    (dict(memory=2**20), (2**20,), "the buffers need 4 MiB, a device has 1 MiB; .* fewer context views"),
    (dict(max_alloc=2**40, memory=2**40), (289, 12_000_000), r"more than 2\^31 elements.* smaller splatting.radius"),
])
def test_refused_before_anything_is_allocated(monkeypatch, info, shape, sentence):
    monkeypatch.setattr(arena.cl, "Buffer", lambda *_: pytest.fail("allocated"))
    with pytest.raises(DeviceError, match=sentence):
        Arena(device(**info), [BufferSpec("depth", shape, np.float32)])


def test_an_allocation_that_fails_gives_the_others_back(monkeypatch):
    released = []

    def buffer(context, flags, nbytes):
        if nbytes == 12:
            raise cl.MemoryError("clCreateBuffer failed: MEM_OBJECT_ALLOCATION_FAILURE")
        return SimpleNamespace(release=lambda: released.append(nbytes))

    monkeypatch.setattr(arena.cl, "Buffer", buffer)
    specs = [BufferSpec(str(n), (n,), np.float32) for n in (1, 2, 3)]
    with pytest.raises(DeviceError, match="refused 0 MiB .* close other programs"):
        Arena(device(), specs)
    assert released == [4, 8]
