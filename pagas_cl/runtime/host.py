"""Memory and threads of this process on the host."""

import ctypes
import os
import sys
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

Item = TypeVar("Item")
Answer = TypeVar("Answer")
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3      # M_TRIM_THRESHOLD, M_MMAP_THRESHOLD of malloc.h
_THREADS = min(8, 2 + (os.cpu_count() or 8))      # more of them hold one another up


def side_by_side(work: Callable[[Item], Answer], items: Iterable[Item], threads: int = _THREADS) -> list[Answer]:
    """`work` of each, in their order, so many at a time: for what decoders and NumPy do, which let other threads on."""
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(work, items))


def available_mb() -> float:
    """Host memory free without swapping, MB: the least of /proc and cgroup 2, Windows' figure, or all there is."""
    if sys.platform == "win32":
        status = (ctypes.c_uint64 * 8)(64)      # MEMORYSTATUSEX: its length, all there is, what is free, ...
        ctypes.windll.kernel32.GlobalMemoryStatusEx(status)
        return status[2] / 1e6
    found = [os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 1e6]
    try:
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                found.append(float(line.split()[1]) * 1024 / 1e6)
        limit = Path("/sys/fs/cgroup/memory.max").read_text().strip()
        if limit != "max":
            found.append((float(limit) - float(Path("/sys/fs/cgroup/memory.current").read_text())) / 1e6)
    except (OSError, ValueError, IndexError):
        pass
    return max(min(found), 1.0)


def keep_freed(kept: bool) -> None:
    """Whether what arrays of 4 to 32 MB leave is kept for the next ones from now on, or goes back to the system.

    A setting of the process, which the command line and worker processes make for themselves: the library never does.
    glibc, left to itself, keeps a third of a run's memory. New memory for each array takes time: 49 depth maps of two
    megapixels are aligned in scale in 3.8 s of processor time where all goes back, in 2.6 by itself, in 2.2 where all
    is kept.
    """
    _call_glibc("mallopt", _MMAP_THRESHOLD, (32 if kept else 4) << 20)
    _call_glibc("mallopt", _TRIM_THRESHOLD, (1024 if kept else 4) << 20)


def trim() -> None:
    """Give back to the system what was freed and is kept for the next time; for who owns the process, as above."""
    _call_glibc("malloc_trim", 0)


def _call_glibc(function: str, *numbers: int) -> None:
    if sys.platform == "linux":
        with suppress(OSError, AttributeError):       # another C library
            getattr(ctypes.CDLL(None), function)(*numbers)
