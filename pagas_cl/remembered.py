"""What the stages of commands took on this machine, kept from one run to the next: the time left is told from it, and
nothing else depends on it. What cannot be read or written is done without."""

import json
from typing import Any

import numpy as np

from pagas_cl.errors import log
from pagas_cl.outlook import PARTS, Course
from pagas_cl.runtime import cache
from pagas_cl.runtime.info import DeviceInfo
from pagas_cl.runtime.trial import identity, kernels

_SIZES = 6        # amounts of work of which a stage's times are kept, the last ones
_ALIKE = 1.3      # factor between amounts of work that are one


class Remembered:
    """Of each stage the courses that it took on a device, with these kernels, by the amount of work."""

    def __init__(self, info: DeviceInfo):
        self._key = cache.digest(identity(info), info.compute_units)      # fewer cores are another machine
        self._seen = self._read()

    def course(self, stage: str, work: float) -> Course | None:
        """Of so much `work`, between the two nearest amounts that were seen; None where the stage never was."""
        seen = sorted(self._seen.get(stage, ()))
        if not seen:
            return None
        known = np.log([amount for amount, _ in seen])
        paces = np.array([course for _, course in seen]) / np.exp(known)[:, None]
        return [work * float(np.interp(np.log(work), known, pace)) for pace in paces.T]

    def keep(self, courses: dict[str, tuple[float, Course]]) -> None:
        """Of each stage (work, course), for the next run; with what another run has kept meanwhile."""
        self._seen = self._read()
        for stage, (work, course) in courses.items():
            kept, like = [], course
            for amount, earlier in self._seen.get(stage, ()):
                if work / _ALIKE < amount < work * _ALIKE:
                    like = [(work / amount * a + b) / 2 for a, b in zip(earlier, like)]
                else:
                    kept.append((amount, earlier))
            self._seen[stage] = [*kept, (work, like)][-_SIZES:]
        text = {stage: [[amount, [round(x, 4) for x in course]] for amount, course in seen]
                for stage, seen in self._seen.items()}
        try:
            cache.write_whole(cache.folder() / "times" / f"{self._key}.json",
                              json.dumps({"kernels": kernels(), "stages": text}))
        except OSError as error:
            log.debug("what the stages took is not kept for the next run: %s", error)

    def _read(self) -> dict[str, list[tuple[float, Course]]]:
        kept = cache.read("times", self._key) or {}
        if kept.get("kernels") != kernels():
            return {}
        try:
            return {stage: [_checked(amount, course) for amount, course in seen]
                    for stage, seen in kept["stages"].items()}
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            log.debug("what the stages took in earlier runs is not readable: %r", error)
            return {}


def _checked(amount: Any, course: Any) -> tuple[float, Course]:
    numbers = [float(number) for number in (amount, *course)]
    if len(numbers) != PARTS + 2 or not all(0 <= number < 1e9 for number in numbers) or not amount > 0:
        raise ValueError(f"{numbers} is no amount of work with the course of a stage")
    return numbers[0], numbers[1:]
