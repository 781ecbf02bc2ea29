"""Memory of this process on the host."""

import ctypes
import sys
from contextlib import suppress
from pathlib import Path


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
