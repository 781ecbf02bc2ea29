"""What the stages of commands took on this machine, kept from one run to the next: the time left is told from it, and
nothing else depends on it. What cannot be read or written is done without."""

import json
from typing import Any

import numpy as np

from pagas_cl.errors import log
from pagas_cl.outlook import Course, until
from pagas_cl.runtime import cache
from pagas_cl.runtime.info import DeviceInfo
from pagas_cl.runtime.trial import identity, kernels

_KIND = "times"    # in the cache
_SIZES = 6        # amounts of work of which a stage's times are kept, the last ones
_ALIKE = 1.3      # factor between amounts of work that are one


class Remembered:
    """Of each stage the courses that it took on a device, with these kernels, by the amount of work."""

    def __init__(self, info: DeviceInfo):
        self._key = cache.digest(identity(info), info.compute_units)      # fewer cores are another machine
        self._seen = self._read()

    def course(self, stage: str, work: float) -> Course | None:
        """Of so much `work`, between the amounts that were seen; None where the stage never was."""
        seen = sorted(self._seen.get(stage, ()))
        if not seen:
            return None
        known = np.log([amount for amount, _ in seen])
        nearest = seen[int(np.argmin(np.abs(known - np.log(work))))][1]
        return [(done, work * float(np.interp(np.log(work), known, [until(course, done) / amount
                                                                    for amount, course in seen])))
                for done, _ in nearest]

    def keep(self, courses: dict[str, tuple[float, Course]]) -> None:
        """Of each stage (work, course), for the next run; with what another run has kept meanwhile."""
        self._seen = self._read()
        for stage, (work, course) in courses.items():
            kept = []
            for amount, earlier in self._seen.get(stage, ()):
                if not work / _ALIKE < amount < work * _ALIKE:
                    kept.append((amount, earlier))
                elif len(earlier) > 2:       # not the guess of a first run
                    course = [(done, (seconds + work / amount * until(earlier, done)) / 2) for done, seconds in course]
            self._seen[stage] = [*kept, (work, course)][-_SIZES:]
        text = {stage: [[amount, [[round(done, 4), round(seconds, 4)] for done, seconds in course]]
                        for amount, course in seen] for stage, seen in self._seen.items()}
        try:
            cache.write_whole(cache.path_of(_KIND, self._key), json.dumps({"kernels": kernels(), "stages": text}))
        except OSError as error:
            log.debug("what the stages took is not kept for the next run: %s", error)

    def _read(self) -> dict[str, list[tuple[float, Course]]]:
        kept = cache.read(_KIND, self._key) or {}
        if kept.get("kernels") != kernels():
            return {}
        try:
            return {stage: [_checked(amount, course) for amount, course in seen]
                    for stage, seen in kept["stages"].items()}
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            log.debug("what the stages took in earlier runs is not readable: %r", error)
            return {}


def _checked(amount: Any, course: Any) -> tuple[float, Course]:
    numbers = np.array(course, float)
    if numbers.ndim != 2 or numbers.shape[1] != 2 or not (
            0 < amount < 1e9 and (numbers >= 0).all() and (numbers < 1e9).all() and numbers[-1, 0] == 1
            and (np.diff(numbers, axis=0) >= 0).all()):
        raise ValueError(f"{course} is no course of a stage with {amount} seconds of work")
    return float(amount), [(done, seconds) for done, seconds in numbers.tolist()]
