"""Runs the installed command as people do: in a terminal of 120 x 40 with live progress, and in a pipe."""

import fcntl
import os
import pty
import re
import select
import signal
import struct
import subprocess
import sys
import termios
import time
from pathlib import Path
from typing import NamedTuple

COMMAND = Path(sys.executable).with_name("pagas-cl")
LONGEST = 240         # seconds that a run may take
_ESCAPE = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")
_FAULT = re.compile(r"Traceback|\b\w*(Error|Exception|Warning):|\.py:\d+|^Aborted|[Ss]egmentation fault", re.MULTILINE)
_OF_THE_TERMINAL = ("NO_COLOR", "FORCE_COLOR", "COLUMNS", "LINES", "TTY_COMPATIBLE", "TTY_INTERACTIVE")


class Ran(NamedTuple):
    """How a run has ended, and what it has written on both streams; of a terminal unchanged, escapes included."""

    status: int
    raw: str

    @property
    def text(self) -> str:
        """Without escapes, empty lines, and all but the last of the bars that were drawn."""
        lines = [line.rstrip() for line in _ESCAPE.sub("", self.raw).replace("\r", "\n").split("\n") if line.strip()]
        return "\n".join(line for line, after in zip(lines, [*lines[1:], ""]) if not ("━" in line and "━" in after))

    def must_end_well(self, *statuses: int, fault: bool = False) -> None:
        """Fail unless it ended with one of `statuses`; nothing may look like a traceback, but with `fault`."""
        assert self.status in statuses, f"status {self.status}, expected {statuses}:\n{self.text[-3000:]}"
        found = None if fault else _FAULT.search(self.text)
        assert found is None, f"{found.group()!r} in:\n{self.text[max(0, found.start() - 500):found.end() + 1500]}"


def run(arguments, place: str, until: str = "") -> Ran:
    """The command with `arguments`, in a "terminal" or a "pipe"; Ctrl-C once `until` can be read."""
    return (in_terminal if place == "terminal" else in_pipe)(arguments, until)


def in_terminal(arguments, until: str = "") -> Ran:
    """In a terminal of its own, which it controls, so that Ctrl-C is a key."""
    controller, terminal = pty.openpty()
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 40, 120, 0, 0))
    process = subprocess.Popen([COMMAND, *arguments], stdin=terminal, stdout=terminal, stderr=terminal,
                               env=_environment(), start_new_session=True,
                               preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0))
    os.close(terminal)
    try:
        return _followed(process, controller, until, lambda: os.write(controller, b"\x03"))
    finally:
        os.close(controller)


def in_pipe(arguments, until: str = "") -> Ran:
    """Standard output and standard error in one pipe."""
    process = subprocess.Popen([COMMAND, *arguments], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
                               stderr=subprocess.STDOUT, env=_environment())
    with process.stdout:
        return _followed(process, process.stdout.fileno(), until, lambda: process.send_signal(signal.SIGINT))


def killed(arguments, folder: Path) -> None:
    """In a pipe, killed once a view is finished in the work folder below `folder`."""
    process = subprocess.Popen([COMMAND, *arguments], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
                               stderr=subprocess.DEVNULL, env=_environment())
    while process.poll() is None and not any(files and place.endswith("views") for place, _, files in os.walk(folder)):
        time.sleep(0.005)
    process.kill()
    process.wait()


def _environment() -> dict[str, str]:
    kept = {name: value for name, value in os.environ.items() if name not in _OF_THE_TERMINAL}
    return {**kept, "TERM": "xterm-256color"}


def _followed(process, descriptor: int, until: str, interrupt) -> Ran:
    """What comes out of `descriptor` until the process has ended; killed after LONGEST seconds."""
    came, end = b"", time.monotonic() + LONGEST
    while True:
        if not select.select([descriptor], [], [], max(0.0, end - time.monotonic()))[0]:
            process.kill()
            raise TimeoutError(f"{process.args} runs for more than {LONGEST} seconds:\n{came.decode()[-3000:]}")
        try:
            some = os.read(descriptor, 1 << 16)
        except OSError:       # of a terminal whose last process has gone
            some = b""
        if not some:
            return Ran(process.wait(), came.decode(errors="replace"))
        came += some
        if until and until.encode() in came:
            interrupt()
            until = ""
