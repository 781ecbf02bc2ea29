"""How long a run has yet to take, of all of its stages, those that are still to come among them.

What a stage should take is known beforehand, from an earlier run here or for some machine or other. What has been
measured so far tells how much faster or slower this run is, for work of the device and of the host each: that goes for
the stages to come; the one under way tells of itself, the more of it is done.
"""

import time
from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass, field
from math import inf
from typing import TypeAlias

_PART = 0.02      # of a stage, after which it is noted again how long it took
_FIRM = 0.1       # what is expected counts as so much of a stage that was seen
_KNOWN = 0.3      # the same of how fast the machine is, where it was seen here before
_SMALL = 0.2      # share of a stage that its first piece may be, and be left out of account
_USUAL = 0.5      # seconds that are seen before anything is known of the machine

Course: TypeAlias = list[tuple[float, float]]
"""How a stage goes: (share that is done, seconds until then), both rising, the last share 1. Before the first share
nothing is done: kernels are built, photos read."""


def even(seconds: float, first: float = 0.0) -> Course:
    """So many seconds of work, as fast at its end as at its beginning, after what comes `first`."""
    return [(0.0, first), (1.0, first + seconds)]


def until(course: Course, done: float) -> float:
    """Seconds until so much is done."""
    after = bisect_right(course, (done, inf))
    if after in (0, len(course)):
        return course[min(after, len(course) - 1)][1]
    (begin, before), (end, then) = course[after - 1:after + 1]
    return before + (done - begin) / (end - begin) * (then - before)


@dataclass
class _Stage:
    """`course`: what is expected of all of it (None: nothing is; `known`: as it was here before), of which this run
    does `share`; `spent` on it until `done`, 0 to 1 of that, `took` so far, and `first` on what says nothing
    of the rest; `before` units were done by an earlier run."""

    course: Course | None = None
    kind: str = ""
    known: bool = False
    share: float = 1.0
    spent: float = 0.0
    done: float = 0.0
    took: Course = field(default_factory=list)
    first: tuple[float, float] | None = None
    before: float = 0.0
    begun: bool = False
    passed: bool = False

    def expected(self, done: float) -> float:
        """Seconds until so much of it is done."""
        return until(self.course, done) * self.share if self.course and done > 0 else 0.0

    def reach(self, done: float, seconds: float, unit: float = 0.0) -> None:
        """After so many `seconds` more so much is done; `unit`: of which one is a view."""
        self.spent += seconds
        if done <= self.done:
            return
        if not self.took and done >= _SMALL:
            self.took.append((0.0, 0.0))
        if not self.took or done >= min(self.took[-1][0] + _PART, 1.0):
            self.took.append((done, self.spent))
        if self.first is None or done <= unit and self._builds(done):
            self.first = (self.spent, done) if self._is_small(done) or self._builds(done) else (0.0, 0.0)
        self.done = done

    def left(self, speed: float) -> float:
        """Seconds, on a machine that takes `speed` times what was expected; NaN where a first small piece, with which
        kernels are built, is all that is known."""
        if self.course is None or self.passed:
            return 0.0 if self.passed else self._left_by_itself()
        total, (spent, expected) = self.expected(1.0), self.after_first()
        firm = _FIRM * total
        pace = (spent + firm * speed) / (expected + firm) if total else 0.0
        return pace * (total - self.expected(self.done))

    def _is_small(self, done: float) -> bool:
        return done < (_SMALL if self.course else _FIRM)

    def _builds(self, done: float) -> bool:
        """Whether most of the time until then should be that of what comes first."""
        return self.course is not None and not self.known and 2 * self.course[0][1] > until(self.course, done)

    def after_first(self) -> tuple[float, float]:
        """Seconds that were spent, and expected, without a first piece, or view, that says nothing of the others:
        kernels are built with it."""
        spent, done = self.first or (self.spent, self.done)
        return self.spent - spent, self.expected(self.done) - self.expected(done)

    def _left_by_itself(self) -> float:
        spent, done = self.first or (0.0, 0.0)
        if self.done > done:
            return (self.spent - spent) * (1 - self.done) / (self.done - done)
        return float("nan") if self.done else 0.0


class Outlook:
    """Listens to progress(stage, done, total), and tells the time left of all stages. Time between two calls goes to
    the stage of the later one; where that only begins (0 done), to that of the earlier one."""

    def __init__(self, clock: Callable[[], float] = time.monotonic):
        self._clock, self._stages = clock, dict[str, _Stage]()
        self._under: _Stage | None = None
        self.now = self.began = float("nan")      # of the last call, and of the first

    def expect(self, stage: str, course: Course, kind: str = "device", known: bool = False) -> None:
        """In its turn `stage` will come, with that course; those of one `kind` are as fast or slow. `known`: here, from
        an earlier run."""
        if self.began != self.began:
            self.began = self.now = self._clock()
        found = self._stages.setdefault(stage, _Stage())
        found.course, found.kind, found.known = course, kind, known

    def expect_some(self, stage: str, number: int, total: int, of: int) -> None:
        """Of `total` units of `stage` this run does the last `number`; `of` so many were expected."""
        found = self._stages.setdefault(stage, _Stage())
        found.before, found.share = total - number, number / max(of, 1)

    def __call__(self, stage: str, done: float, total: float) -> None:
        now, found = self._clock(), self._stages.setdefault(stage, _Stage())
        if self.began != self.began:
            self.began = self.now = now
        if not found.begun:
            for earlier in list(self._stages.values())[:list(self._stages).index(stage)]:
                earlier.passed = not earlier.begun        # was not called for, so far
        share = (done - found.before) / (total - found.before) if total > found.before else 1.0
        if done == 0 and self._under:
            self._under.reach(self._under.done, now - self.now)
            found.reach(share, 0.0)
        else:
            found.reach(share, now - self.now, 1 / (total - found.before) if total - found.before > 1 else 0.0)
        found.begun, found.passed, self.now, self._under = True, False, now, found

    def left(self) -> float:
        """Seconds that were left at the last call; NaN where nobody can tell."""
        kinds = {stage.kind for stage in self._stages.values()}
        alone = {kind: self._speed(kind, 1.0) for kind in kinds}
        speed = {kind: self._speed(kind, max([1.0, *(alone[other] for other in kinds - {kind})])) for kind in kinds}
        return sum(stage.left(speed[stage.kind]) for stage in self._stages.values())

    def courses(self) -> dict[str, tuple[float, float, Course]]:
        """Of the stages that this run brought to their end: the share that it did, how many times as long as expected
        work of that kind took, and what this took."""
        return {name: (stage.share, self._speed(stage.kind, 1.0), [*stage.took[:-1], (1.0, stage.spent)])
                for name, stage in self._stages.items() if stage.begun and stage.done >= 1 and stage.share > 0}

    def _speed(self, kind: str, usual: float) -> float:
        seen = [stage for stage in self._stages.values() if stage.kind == kind and stage.begun and stage.course]
        took = [stage.after_first() for stage in seen]
        firm = _USUAL + _KNOWN * sum(stage.expected(1.0) for stage in self._stages.values() if stage.known)
        return (sum(spent for spent, _ in took) + firm * usual) / (sum(expected for _, expected in took) + firm)
