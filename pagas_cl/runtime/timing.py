"""Time by stage, from the device's own clock."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import pyopencl as cl

from pagas_cl.runtime.program import Work


def stage_times(queue: cl.CommandQueue, launches: Sequence[Work], repeats: int = 5) -> dict[str, tuple[float, int]]:
    """Run `launches` in order `repeats` times on a profiling `queue`.

    Returns
    -------
    dict of stage name to (milliseconds per repeat, launches per repeat)
        The mean over the repeats after one that is not counted: a first launch may still compile.
    """
    total: dict[str, float] = defaultdict(float)
    count: dict[str, int] = defaultdict(int)
    for repeat in range(repeats + 1):
        events = [(launch.stage, launch.enqueue(queue)) for launch in launches]
        queue.finish()
        for stage, event in events if repeat else ():
            total[stage] += (event.profile.end - event.profile.start) * 1e-6 / repeats
            count[stage] += 1
    return {stage: (total[stage], count[stage] // repeats) for stage in total}
