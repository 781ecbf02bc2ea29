"""Memory and threads of this process on the host."""

import ctypes
import sys
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

Item = TypeVar("Item")
Answer = TypeVar("Answer")


def side_by_side(work: Callable[[Item], Answer], items: Iterable[Item], threads: int = 8) -> list[Answer]:
    """`work` of each, in their order, so many at a time: for what decoders and NumPy do, which let other threads on."""
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(work, items))


def trim() -> None:
    """Give back to the system what was freed and is kept for the next time: with glibc a third of a run's memory."""
    if sys.platform == "linux":
        with suppress(OSError, AttributeError):       # another C library
            ctypes.CDLL(None).malloc_trim(0)


def resident_mb() -> float:
    """Host memory that this process holds, MB; 0 where the system does not tell as Linux does."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return 0.0
    return next((float(line.split()[1]) * 1024 / 1e6 for line in lines if line.startswith("VmRSS:")), 0.0)
