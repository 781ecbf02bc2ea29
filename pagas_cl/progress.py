"""What a run of many views tells its caller: views that are done, and the part of one that is under way."""

from collections.abc import Callable
from typing import Any, TypeAlias

# What a caller is told of a run by: (stage, done, total).
Progress: TypeAlias = Callable[[str, float, float], Any]
_STEPS = 0.95     # of a view's time; what judges and writes its depth comes after


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

    def further(self, share: float) -> None:
        """Such a share of what was left is done."""
        self.at(self._most + share * (self.total - self._most))

    def inside(self, done: int) -> Progress | None:
        """Progress of refine_depth for the view after the first `done`; None where nobody is told."""
        return self.progress and (lambda stage, steps, of: self.at(done + _STEPS * steps / of))
