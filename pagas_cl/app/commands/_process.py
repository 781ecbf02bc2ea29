"""What the command line, not the library, sets in its process, and what it writes to standard error."""

import atexit
import errno
import logging
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import warnings
from collections import Counter
from collections.abc import Iterable
from contextlib import contextmanager
from functools import cache

from pagas_cl.errors import NothingRefinedError, NothingRefinedWarning, log
from pagas_cl.progress import NONE, BarProgress, LineProgress, Progress
from pagas_cl.runtime import cache as user_cache
from pagas_cl.runtime import host
from pagas_cl.runtime.device import Device, open_device


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
            gone = error.errno in (errno.EPIPE, errno.EINVAL)      # as Windows says that nobody reads any more
            self.fault = "" if gone else error.strerror or str(error)
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


def typed(arguments: Iterable[str]) -> str:
    """A command line as this system's shell takes it."""
    return subprocess.list2cmdline(arguments) if sys.platform == "win32" else shlex.join(arguments)


@cache
def console():
    """The one rich console on standard error, so that messages appear above a progress bar and not through it."""
    from rich.console import Console

    return Console(stderr=True)


_PLACES = re.compile(r"%[-+#0]*[\d.,]*[a-z]")      # where logging puts values into a message


class Once(logging.Filter):
    """Passes each warning once, and no more than MOST of one kind; `rest` says how many were left out."""

    MOST = 5

    def __init__(self):
        super().__init__()
        self._shown: set[str] = set()
        self._kinds: Counter[str] = Counter()

    def filter(self, record: logging.LogRecord) -> bool:
        if record.levelno != logging.WARNING:
            return True
        text = record.getMessage()
        if text in self._shown:
            return False
        self._shown.add(text)
        self._kinds[record.msg] += 1
        return self._kinds[record.msg] <= self.MOST

    def rest(self) -> list[str]:
        """A line for each kind of which some were left out."""
        return [f"{left} more warning{'s' * (left > 1)} like '{_PLACES.sub('...', str(kind))}' (--verbose shows all)"
                for kind, count in self._kinds.items() if (left := count - self.MOST) > 0]


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
    before = log.handlers, log.propagate, log.level
    log.handlers, log.propagate = [handler], False
    log.setLevel(logging.DEBUG if details else logging.INFO)
    try:
        yield
    finally:
        handler.removeFilter(once)
        for line in once.rest() if not details else ():
            log.warning("%s", line)
        log.handlers, log.propagate = before[:2]
        log.setLevel(before[2])


@contextmanager
def nothing_refined():
    """Context of work whose NothingRefinedWarning is reported when all else is done: as NothingRefinedError, for the
    status, or in the log where something was refined. The list of such sentences, as they come."""
    texts, show = [], warnings.showwarning
    with warnings.catch_warnings():
        warnings.simplefilter("always", NothingRefinedWarning)
        warnings.showwarning = lambda message, category, *place, **more: (
            texts.append(str(message)) if category is NothingRefinedWarning
            else show(message, category, *place, **more))
        yield texts
    for text in texts:
        if text.startswith("nothing"):
            raise NothingRefinedError(f"{text.replace('nothing was refined', 'NOTHING WAS REFINED', 1)}; what was "
                                      "written holds no refined depth")
        log.warning("%s", text)


def shown_progress(quiet: bool = False) -> Progress:
    """A bar a stage on a terminal, else a line a stage, on standard error; nothing where `quiet`."""
    if quiet:
        return NONE
    return BarProgress(console()) if sys.stderr.isatty() else LineProgress(sys.stderr)


def opened_device(name: str | None) -> Device:
    """As open_device; from here on the process keeps the memory of freed arrays where that suits the device."""
    device = open_device(name)
    host.keep_freed(device.info.kind != "CPU")       # whose memory is the host's
    return device


def replace_cache() -> None:
    """Where the user's cache folder cannot be written PoCL has no device, and pyopencl does not compile: another folder
    for this process and its children (XDG_CACHE_HOME), removed when it ends."""
    try:
        user_cache.folder().mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=user_cache.folder()):
            pass
    except OSError as error:
        log.warning("%s cannot be written (%s): the device is tried and its kernels are compiled anew in every run; "
                    "name another folder with XDG_CACHE_HOME", user_cache.folder(), error.strerror or error)
        folder = tempfile.mkdtemp(prefix="pagas_cl-cache-")
        os.environ["XDG_CACHE_HOME"] = folder
        atexit.register(_remove, folder, os.getpid())


def _remove(folder: str, process: int) -> None:
    if os.getpid() == process:
        shutil.rmtree(folder, ignore_errors=True)
