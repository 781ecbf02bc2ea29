"""Compiled programs, kept on disk for later processes: a driver that keeps them itself still reads the source, and PoCL
its own header of 16,000 lines, 50 ms a program.

PoCL also compiles all kernels of a program a second time, for work-groups of any size, before it gives it away: one to
two seconds, as much as forty processes save that read the program. So only what has been built BUILDS times is stored.
"""

import hashlib
from contextlib import suppress
from pathlib import Path

import pyopencl as cl

from pagas_cl.runtime import cache
from pagas_cl.runtime.device import Device
from pagas_cl.runtime.trial import identity
from pagas_cl.runtime.vendors import POCL

BUILDS = 20
_DIGEST = hashlib.sha256().digest_size      # bytes before a binary: its own hash


def compiled(device: Device, text: str, options: list[str]) -> cl.Program:
    """The source `text` built for `device`; cl.RuntimeError where it does not compile."""
    path = cache.folder() / "programs" / f"{cache.digest(identity(device.info), text, options)}.bin"
    kept, one = _kept(path), device.queue.device
    if kept:
        with suppress(cl.Error):      # a driver may refuse its own of before
            read: cl.Program = cl.Program(device.context, [one], [kept]).build(options, [one])
            return read
    built: cl.Program = cl.Program(device.context, text).build(options, [one])
    if device.info.platform == POCL and not path.exists() and _builds(path.with_suffix(".builds")) < BUILDS:
        return built
    binary: bytes = built.binaries[built.devices.index(one)]
    with suppress(OSError):      # the trial of the device has said that nothing can be stored
        cache.write_whole(path, hashlib.sha256(binary).digest() + binary)
    return built


def _builds(path: Path) -> int:
    """How often a program has been built, this time included: a file with a byte for each."""
    with suppress(OSError):
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with path.open("ab") as file:
            file.write(b".")
        return path.stat().st_size
    return 0


def _kept(path: Path) -> bytes:
    """The binary in a file; empty where there is none, or not as it was written."""
    with suppress(OSError):
        held: bytes = path.read_bytes()
        if hashlib.sha256(held[_DIGEST:]).digest() == held[:_DIGEST]:
            return held[_DIGEST:]
    return b""
