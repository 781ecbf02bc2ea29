"""How much host memory is free."""

from __future__ import annotations

from pathlib import Path


def available_mb() -> float:
    """Host memory that can be taken without swapping, MB: the least of what the system and the container allow.

    Infinite where neither says (neither /proc nor cgroup version 2).
    """
    found = [float("inf")]
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
