"""Progress that tells of steps when the device has done them, not when they are enqueued."""

from __future__ import annotations

from collections import deque

AHEAD = 8          # steps that stay enqueued beyond the one that is told of: the device never waits for the host


class StepProgress:
    """Calls `progress(done, total)` after each step; does nothing where that is None.

    Parameters
    ----------
    progress : callable of (done, total), or None
    total : int
    """

    def __init__(self, progress, total: int):
        self.progress, self.total, self._under_way = progress, total, deque()

    def enqueued(self, number: int, event):
        """Step `number` (from 1) was; `event` ends it."""
        if self.progress:
            self._under_way.append((number, event))
        while len(self._under_way) > AHEAD:
            self._wait()

    def finish(self):
        """Wait for the last ones."""
        while self._under_way:
            self._wait()

    def _wait(self):
        number, event = self._under_way.popleft()
        event.wait()
        self.progress(number, self.total)
