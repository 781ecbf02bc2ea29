"""Asking a driver or a library in a process of its own, so that one that crashes or hangs does not take us along."""

import ctypes
import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from typing import IO, Any


@dataclass(frozen=True)
class Answer:
    """What a child process came to; `value` is None where it ended without an answer."""

    value: dict[str, Any] | None
    fault: str = ""         # how it ended then: "crashed (SIGABRT: ...)", "gave no answer within 60 s", ...
    hung: bool = False      # it gave no answer in time
    crashed: bool = False   # by a signal, or, as on Windows, with a status that Python has not


def answer(work: Callable[..., dict[str, Any]]) -> None:
    """In a child of `ask`, which ends with its parent: write what work(**question) gives."""
    end_with_parent()
    sys.stdout.write("\n" + json.dumps(work(**json.loads(sys.argv[1]))) + "\n")


def end_with_parent() -> None:
    """Be killed with the thread that has started this process, even inside a driver that never returns. On Linux
    alone; on other systems a driver that hangs outlives a parent that is killed."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)     # PR_SET_PDEATHSIG


def ask(module: str, question: dict[str, Any], timeout: float, environment: dict[str, str] | None = None) -> Answer:
    """Run `python -m module QUESTION`; the last line that it writes is its answer, as JSON.

    `environment` is set on top of this process' own.
    """
    with (tempfile.TemporaryFile("w+", errors="replace") as out,      # a driver writes in whatever encoding
          tempfile.TemporaryFile("w+", errors="replace") as errors):
        # Files, not pipes: what a driver has started would hold a pipe open after the child has been killed.
        child = subprocess.Popen([sys.executable, "-m", module, json.dumps(question)], stdin=subprocess.DEVNULL,
                                 stdout=out, stderr=errors, start_new_session=True,
                                 env={**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
                                      "PYTHONSAFEPATH": "1", **(environment or {})})
        try:
            status = child.wait(timeout)
        except subprocess.TimeoutExpired:
            return Answer(None, f"gave no answer within {timeout:g} s", hung=True)
        finally:
            _end(child)
        try:
            return Answer(json.loads(_lines(out)[-1]))
        except (IndexError, ValueError):
            return Answer(None, _ending(status, _lines(errors)), crashed=status not in (0, 1))


def _end(child: subprocess.Popen[bytes]) -> None:
    """Nothing that it has started is left."""
    try:
        if hasattr(os, "killpg"):
            os.killpg(child.pid, signal.SIGKILL)
        else:
            child.kill()
    except (ProcessLookupError, PermissionError):     # all of it has ended
        pass
    child.wait()


def _lines(file: IO[str]) -> list[str]:
    file.seek(0)
    return [line.strip() for line in file.read().splitlines() if line.strip()]


def _ending(status: int, errors: list[str]) -> str:
    named = [line for line in errors if "error" in line.lower() or "terminate" in line.lower()]
    message = (named or errors or ["no message"])[0 if named else -1][:200]
    if status >= 0:
        return f"ended with status {status} ({message})"
    try:
        name = signal.Signals(-status).name
    except ValueError:
        name = f"signal {-status}"
    return f"crashed ({name}: {message})"
