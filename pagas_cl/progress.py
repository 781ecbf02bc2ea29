"""Progress inside of a part: callables of (stage, done, total), where `done` may be a fraction."""

from __future__ import annotations

STEPS = 0.95       # of a view; what judges and writes its depth comes after


def inside_of(progress, done: int, total: int):
    """Progress of the steps of one view as that of `total` views of which `done` are finished; None without one."""
    return progress and (lambda stage, steps, of: progress("refine", done + STEPS * steps / of, total))
