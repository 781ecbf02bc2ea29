"""How a run reports how far it is: a stage is started with its total, advances, and is finished.

Every public function takes `progress`: None (nothing is shown), True (bars on a terminal or in a notebook, else a line
a stage), a function (stage, done, total), or an object of one's own with the method of `Progress`.
"""

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, TextIO, TypeAlias, TypeVar, runtime_checkable

from pagas_cl.errors import InputError, plain

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress as RichProgress

Item = TypeVar("Item")
OnStep: TypeAlias = Callable[[int, int], Any]
"""Called with (steps done, all steps) of a view."""

_STEPS = 0.95     # of a view's time; what judges and writes its depth comes after them


class Stage(Protocol):
    """A stage that is under way."""

    def advance(self, done: float) -> None:
        """So much of the total is done by now; a fraction lies within the unit of work under way."""

    def finish(self) -> None:
        """The stage has ended: all of it is done, or an error has ended it earlier."""


@runtime_checkable
class Progress(Protocol):
    """Shows the stages of a run."""

    def start(self, name: str, total: float) -> Stage:
        """A stage of `total` units of work (views, settings, ...) begins."""


Reporter: TypeAlias = Progress | Callable[[str, float, float], Any] | bool | None
"""What public functions take as `progress`."""


@contextmanager
def stage(progress: Progress, name: str, total: float) -> Iterator[Stage]:
    """Context of a stage: started at its beginning, finished at its end, however that comes about."""
    started = progress.start(name, total)
    started.advance(0)
    try:
        yield started
    finally:
        started.finish()


def reported(progress: Progress, name: str, items: Sequence[Item]) -> Iterator[Item]:
    """The `items`, one after the other, as a stage of so many."""
    with stage(progress, name, len(items)) as under_way:
        for number, item in enumerate(items):
            yield item
            under_way.advance(number + 1)


def progress_of(reporter: Reporter) -> Progress:
    """The Progress that a caller's `progress` stands for; InputError for anything else."""
    if reporter is None or reporter is False:
        return NONE
    if reporter is True:
        return shown_on(sys.stderr)
    if isinstance(reporter, Progress):
        return reporter
    if callable(reporter):
        return CallbackProgress(reporter)
    raise InputError(f"progress is a {type(reporter).__name__}, expected True, None, a function (stage, done, total), "
                     "or an object with start(name, total)")


def shown_on(stream: TextIO) -> Progress:
    """Bars where `stream` is a terminal or this is a notebook, else a line a stage."""
    from rich.console import Console

    console = Console(file=stream)
    return BarProgress(console) if console.is_terminal or console.is_jupyter else LineProgress(stream)


def within_view(views: Stage, number: int) -> OnStep:
    """Of the view after the first `number` of a stage of views."""
    return lambda steps, of: views.advance(number + _STEPS * steps / of)


class _RisingStage:
    """Shows more done alone: a view that is tried again shows nothing until it is further than it was."""

    def __init__(self, total: float, show: Callable[[float], Any], close: Callable[[float], Any] = lambda done: None):
        self._total, self._show, self._close = total, show, close
        self._most = -1.0

    def advance(self, done: float) -> None:
        if done > self._most:
            self._most = done
            self._show(min(done, self._total))

    def finish(self) -> None:
        self._close(max(self._most, 0.0))


@dataclass(frozen=True)
class CallbackProgress:
    """Calls function(stage, done, total), with never less done than before."""

    function: Callable[[str, float, float], Any]

    def start(self, name: str, total: float) -> Stage:
        return _RisingStage(total, lambda done: self.function(name, done, total))


class _Nothing:
    """A Progress and a Stage that show nothing."""

    def start(self, name: str, total: float) -> Stage:
        return self

    def advance(self, done: float) -> None:
        pass

    def finish(self) -> None:
        pass


NONE = _Nothing()


@dataclass(frozen=True)
class LineProgress:
    """For a file or a pipe: one line when a stage has ended."""

    stream: TextIO

    def start(self, name: str, total: float) -> Stage:
        began = time.monotonic()
        return _RisingStage(total, lambda done: None, lambda done: self.stream.write(
            f"{plain(name)}: {int(done)} of {int(total)} in {time.monotonic() - began:.0f} s\n"))


class BarProgress:
    """A bar a stage on `console`, with the time that has passed and the time that is left of it, by rich."""

    def __init__(self, console: "Console"):
        self._console = console
        self._bars: RichProgress | None = None
        self._open = 0

    def start(self, name: str, total: float) -> Stage:
        """A stage with a bar; bars stay on the screen when all stages that are under way have ended."""
        if self._bars is None:
            self._bars = _bars(self._console)
            self._bars.start()
        self._open += 1
        bars, task = self._bars, self._bars.add_task(plain(name), total=total)

        def close(done: float) -> None:
            bars.stop_task(task)
            self._open -= 1
            if self._open == 0:
                bars.stop()
                self._bars = None

        return _RisingStage(total, lambda done: bars.update(task, completed=done), close)


def _bars(console: "Console") -> "RichProgress":
    from rich import progress

    roomy = [progress.BarColumn(), progress.TimeElapsedColumn()] if console.width >= 60 else []    # figures come first
    return progress.Progress(progress.TextColumn("{task.description}", markup=False), *roomy[:1],
                             progress.MofNCompleteColumn(), *roomy[1:], progress.TextColumn("left:"),
                             progress.TimeRemainingColumn(), console=console, speed_estimate_period=600,
                             redirect_stdout=False)      # which may be a file, and is none of the bar's
