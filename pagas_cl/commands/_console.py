"""What the commands write to standard error: messages, and progress with the time left."""

import logging
import os
import sys
import time
import warnings
from collections import Counter
from contextlib import contextmanager
from functools import cache

from pagas_cl.errors import NothingRefinedError, NothingRefinedWarning, log, plain
from pagas_cl.outlook import Course, Outlook

_LINE_EVERY = 10.0  # seconds between lines where standard error is a file


class _Lenient:
    """A standard stream; what is written to it is dropped once nobody reads it any more (`| head -1`), or it cannot be
    written for another reason (`fault`), so that the work goes on."""

    def __init__(self, stream):
        self._stream, self.fault = stream, ""

    def __getattr__(self, name: str):
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        self._do(self._stream.write, text)
        return len(text)

    def flush(self) -> None:
        self._do(self._stream.flush)

    def _do(self, what, *arguments) -> None:
        try:
            what(*arguments)
        except OSError as error:
            self.fault = "" if isinstance(error, BrokenPipeError) else error.strerror or str(error)
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._stream.fileno())
            os.close(nowhere)


def make_streams_safe() -> None:
    """Before anything else in a process of our own: standard streams that are closed lead nowhere, and not into the
    next file that is opened; names of files are written even where they are no text."""
    for number, (name, mode) in enumerate((("stdin", "r"), ("stdout", "w"), ("stderr", "w"))):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)      # gets the least number that is free: this one
        stream = getattr(sys, name) or open(number, mode, closefd=False)      # noqa: SIM115
        if mode == "w":
            stream.reconfigure(errors="backslashreplace")
            stream = _Lenient(stream)
        setattr(sys, name, stream)


@cache
def console():
    """The one rich console on standard error, so that messages appear above a progress bar and not through it."""
    from rich.console import Console

    return Console(stderr=True)


class Once(logging.Filter):
    """Tells each warning once, and no more than MOST of one kind; `rest` says how many were left out."""

    MOST = 5

    def __init__(self):
        super().__init__()
        self._told: set[str] = set()
        self._kinds: Counter[str] = Counter()

    def filter(self, record: logging.LogRecord) -> bool:
        if record.levelno != logging.WARNING:
            return True
        text = record.getMessage()
        if text in self._told:
            return False
        self._told.add(text)
        self._kinds[record.msg] += 1
        return self._kinds[record.msg] <= self.MOST

    def rest(self) -> list[str]:
        """A line for each kind of which some were left out."""
        return [f"{count - self.MOST} more warnings like '{str(kind).replace('%s', '...')}' (--verbose shows all)"
                for kind, count in self._kinds.items() if count > self.MOST]


@contextmanager
def log_to_stderr(details: bool = False):
    """Context that sends the messages of the logger "pagas_cl" to standard error, and leaves it as it was; with
    `details` (level DEBUG) also what was measured and planned, and each warning every time."""
    if sys.stderr.isatty():
        from rich.logging import RichHandler

        handler = RichHandler(console=console(), show_time=False, show_path=False)
    else:
        handler = logging.StreamHandler()
        handler.setFormatter(logging.Formatter("%(levelname)s %(message)s"))
    once = Once()
    if not details:
        handler.addFilter(once)
    logger = logging.getLogger("pagas_cl")
    before = logger.handlers, logger.propagate, logger.level
    logger.handlers, logger.propagate = [handler], False
    logger.setLevel(logging.DEBUG if details else logging.INFO)
    try:
        yield
    finally:
        handler.removeFilter(once)
        for line in once.rest() if not details else ():
            logger.warning("%s", line)
        logger.handlers, logger.propagate = before[:2]
        logger.setLevel(before[2])


@contextmanager
def nothing_refined():
    """Context of work whose NothingRefinedWarning is told when all else is done: as NothingRefinedError, for the
    status, or in the log where something was refined."""
    told, show = [], warnings.showwarning
    with warnings.catch_warnings():
        warnings.simplefilter("always", NothingRefinedWarning)
        warnings.showwarning = lambda message, category, *place, **more: (
            told.append(str(message)) if category is NothingRefinedWarning else show(message, category, *place, **more))
        yield
    for text in told:
        if text.startswith("nothing"):
            raise NothingRefinedError(f"{text.replace('nothing was refined', 'NOTHING WAS REFINED', 1)}; what was "
                                      "written holds the depths as they were given")
        log.warning("%s", text)


@contextmanager
def noted(note):
    """Context of work whose NothingRefinedWarning is handed to note(text), too, where that is a function."""
    show = warnings.showwarning

    def both(message, category, *place, **more):
        if note and category is NothingRefinedWarning:
            note(str(message))
        show(message, category, *place, **more)

    warnings.showwarning = both
    try:
        yield
    finally:
        warnings.showwarning = show


@contextmanager
def shown_progress(quiet: bool = False):
    """Context of a callable progress(stage, done, total) that draws a bar, or writes a line now and then."""
    if quiet:
        yield lambda stage, done, total: None
    elif not sys.stderr.isatty():
        yield Lines()
    else:
        with Bar() as bar:
            yield bar


class Bar(Outlook):
    """Progress on a terminal: one bar from start to end, of the time of the whole run."""

    def __init__(self):
        super().__init__()
        from rich import progress

        self._bars = progress.Progress(
            progress.TextColumn("{task.description}", markup=False), progress.BarColumn(),
            progress.TextColumn("{task.fields[count]}"), progress.TimeElapsedColumn(),
            progress.TextColumn("gone, {task.fields[left]} left"), console=console())
        self._task = self._bars.add_task("start", total=1.0, count="", left="?")

    def __enter__(self) -> "Bar":
        self._bars.start()
        return self

    def __exit__(self, *_) -> None:
        self._bars.stop()

    def expect(self, stage: str, course: Course, kind: str = "device", known: bool = False) -> None:
        super().expect(stage, course, kind, known)
        if self._under is None:
            self._show("start", "")

    def __call__(self, stage: str, done: float, total: int) -> None:
        super().__call__(stage, done, total)
        self._show(plain(stage), f"{int(done)}/{total}")

    def _show(self, stage: str, count: str) -> None:
        left, gone = self.left(), self.now - self.began
        known = gone + left > 0      # not where it is NaN
        self._bars.update(self._task, description=stage, completed=gone / (gone + left) if known else 0.0, count=count,
                          left=f"{int(left) // 60}:{int(left) % 60:02}" if known else "?")


class Lines(Outlook):
    """Progress for a file or a pipe: one line every few seconds, and one when a stage is done."""

    def __init__(self, write=None, clock=time.monotonic):
        super().__init__(clock)
        self._write, self._told = write or sys.stderr.write, float("nan")
        self._begins: dict[str, float] = {}

    def __call__(self, stage: str, done: float, total: int) -> None:
        stage = plain(stage)
        super().__call__(stage, done, total)
        began = self._begins.setdefault(stage, self.now)
        self._told = self.began if self._told != self._told else self._told
        if done >= total:
            self._begins.pop(stage)
            self._write(f"{stage}: {total} of {total} in {self.now - began:.0f} s\n")
        elif done and self.now - self._told >= _LINE_EVERY:
            self._told = self.now
            left = self.left()
            self._write(f"{stage}: {int(done)} of {total}" + (f", about {left:.0f} s left\n" if left == left else "\n"))
