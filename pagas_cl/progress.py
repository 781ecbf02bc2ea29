"""What a run of many views tells its caller, views that are done and the part of one that is under way; and how long it
has yet to take, of all of its stages, those that are still to come among them.

What a stage is expected to take is known beforehand for some machine or other. What has been measured so far tells how
much faster or slower this one is, for work of the device and of the host each: that goes for the stages to come; the
one under way tells of itself, the more of it is done.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

# What a caller is told of a run by: (stage, done, total).
Progress: TypeAlias = Callable[[str, float, float], Any]
_STEPS = 0.95     # of a view's time; what judges and writes its depth comes after
_FIRM = 0.1       # what is expected counts as so much of a stage that was seen
_USUAL = 0.5      # seconds that are seen before anything is known of the machine


def tell(progress: Progress | None, what: str, *given: Any) -> None:
    """Tell who listens, if it wants to know, what is to come: `what` is a method of Outlook."""
    if hasattr(progress, what):
        getattr(progress, what)(*given)


class ViewProgress:
    """Calls `progress(stage, done, total)` with views done, a fraction within one; never with fewer than before.

    A view that is tried again says nothing until it is further than it was. `progress` None: nobody is told.
    """

    def __init__(self, progress: Progress | None, total: int, stage: str = "refine"):
        self.progress, self.total, self.stage, self._most = progress, total, stage, -1.0

    def expect(self, number: int, of: int) -> None:
        """So many are left to do, of `of` views that the run has."""
        tell(self.progress, "expect_some", self.stage, number, self.total, of)

    def at(self, done: float) -> None:
        """`done` views are."""
        if self.progress and done > self._most:
            self._most = done
            self.progress(self.stage, done, self.total)

    def inside(self, done: int) -> Progress | None:
        """Progress of refine_depth for the view after the first `done`; None where nobody is told."""
        return self.progress and (lambda stage, steps, of: self.at(done + _STEPS * steps / of))


@dataclass
class _Stage:
    """`seconds` expected of all of it (None: nothing is), of which this run does `share`; `spent` on it until `done`, 0
    to 1 of that, and on the `first` piece of it; `before` units were done by an earlier run."""

    seconds: float | None = None
    kind: str = ""
    share: float = 1.0
    spent: float = 0.0
    done: float = 0.0
    first: tuple[float, float] | None = None
    before: float = 0.0
    begun: bool = False

    @property
    def expected(self) -> float:
        return (self.seconds or 0.0) * self.share

    def left(self, speed: float) -> float:
        """Seconds, on a machine that takes `speed` times what was expected; NaN where a first small piece, with which
        kernels are built, is all that is known."""
        if self.seconds is None:
            if not 0 < self.done < _FIRM or self.first is None:
                return self.spent * (1 - self.done) / self.done if self.done else 0.0
            spent, done = self.spent - self.first[0], self.done - self.first[1]
            return spent * (1 - self.done) / done if done > 0 else float("nan")
        return (self.spent + _FIRM * self.expected * speed) / (self.done + _FIRM) * (1 - self.done)


class Outlook:
    """Listens to progress(stage, done, total), and tells the time left of all stages. Time between two calls goes to
    the stage of the later one; where that only begins (0 done), to that of the earlier one."""

    def __init__(self, clock: Callable[[], float] = time.monotonic):
        self._clock, self._stages = clock, dict[str, _Stage]()
        self._under: _Stage | None = None
        self.now = self.began = float("nan")      # of the last call, and of the first

    def expect(self, stage: str, seconds: float, kind: str = "device") -> None:
        """In its turn `stage` will come, with so many seconds of work; those of one `kind` are as fast or slow."""
        found = self._stages.setdefault(stage, _Stage())
        found.seconds, found.kind = seconds, kind

    def expect_some(self, stage: str, number: int, total: int, of: int) -> None:
        """Of `total` units of `stage` this run does the last `number`; `of` so many were expected."""
        found = self._stages.setdefault(stage, _Stage())
        found.before, found.share = total - number, number / max(of, 1)

    def __call__(self, stage: str, done: float, total: float) -> None:
        now, found = self._clock(), self._stages.setdefault(stage, _Stage())
        if self._under is None:
            self.began = self.now = now
        if not found.begun:
            for earlier in list(self._stages.values())[:list(self._stages).index(stage)]:
                earlier.done = earlier.done if earlier.begun else 1.0        # was not called for
        (self._under if done == 0 and self._under else found).spent += now - self.now
        share = (done - found.before) / (total - found.before) if total > found.before else 1.0
        found.done, found.begun = max(found.done, share), True
        if found.done > 0 and found.first is None:
            found.first = found.spent, found.done
        self.now, self._under = now, found

    def left(self) -> float:
        """Seconds that were left at the last call; NaN where nobody can tell."""
        kinds = {stage.kind for stage in self._stages.values()}
        usual = max([1.0, *(self._speed(kind, 1.0) for kind in kinds)])    # what slows one down slows the others
        speed = {kind: self._speed(kind, usual) for kind in kinds}
        return sum(stage.left(speed[stage.kind]) for stage in self._stages.values())

    def _speed(self, kind: str, usual: float) -> float:
        seen = [stage for stage in self._stages.values() if stage.kind == kind and stage.begun and stage.seconds]
        return (sum(stage.spent for stage in seen) + _USUAL * usual) / (
            sum(stage.expected * stage.done for stage in seen) + _USUAL)
