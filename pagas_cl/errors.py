"""What can go wrong: every message says what, where, got, expected, and what to do; and the log that all write to."""

import copyreg
import logging
import os
import re
from collections.abc import Iterable
from difflib import get_close_matches
from importlib import import_module
from pathlib import Path
from typing import Any

# what a terminal obeys, or what begins another line or direction of writing
_CONTROLS = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069]")

_LONGEST = 60      # characters of a value in a message


def plain(text: str) -> str:
    """One line of text as it may be shown: control characters, which names of files may hold, become escapes."""
    return _CONTROLS.sub(lambda found: ascii(found[0])[1:-1], text)


def short(value: object) -> str:
    """A value's repr as a message may show it, whatever a file holds: its middle left out beyond 60 letters."""
    text = repr(value).replace("\n", " ")
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST // 2 - 3]}...{text[-_LONGEST // 2:]}"


def kind_of(value: object) -> str:
    """What a caller gave, as a message calls it: "None", "a list", "an array of float32"."""
    if value is None:
        return "None"
    name = type(value).__name__.replace("ndarray", "array")
    dtype = getattr(value, "dtype", None)
    article = "an" if name[0].lower() in "aeiou" else "a"
    return f"{article} {name}" + ("" if str(dtype) in ("None", name) else f" of {dtype}")


def check_kind(name: str, value: object, kinds: tuple[Any, ...], expected: str) -> None:
    """InputError where a caller's argument `name` is none of the types `kinds`; `expected`: what these are in words."""
    if not isinstance(value, kinds):
        raise InputError(f"{name} is {kind_of(value)}, expected {expected}")


def as_path(name: str, value: Any) -> Path:
    """A caller's argument `name` as a path; InputError where it is none."""
    check_kind(name, value, (str, os.PathLike), "a path")
    return Path(value)


def _plainly(record: logging.LogRecord) -> bool:
    if isinstance(record.args, tuple):
        record.args = tuple(plain(str(given)) if isinstance(given, (str, os.PathLike, BaseException)) else given
                            for given in record.args)
    return True


log = logging.getLogger("pagas_cl")
log.addFilter(_plainly)


def nearest_of(word: str, known: Iterable[str]) -> str:
    """What a sentence ends with where one of `known`, or what follows its last dot, is nearly `word`; else empty."""
    known = list(known)
    ends = {name.rpartition(".")[2].lower(): name for name in known} | {name.lower(): name for name in known}
    near = get_close_matches(word.rpartition(".")[2].lower(), ends, n=1)
    return f"the nearest one is {ends[near[0]]!r}" if near else ""


class PagasError(Exception):
    """Base of every error that pagas_cl raises on purpose; `exit_status`: what the command line ends with."""

    exit_status = 1

    def __reduce__(self) -> Any:        # pools of processes pass errors on, whatever their __init__ takes
        return copyreg.__newobj__, (type(self), *self.args), vars(self)


class InputError(PagasError, ValueError):
    """The caller's data or settings cannot be used. `at_command_line`: what the command line says instead."""

    exit_status = 2
    at_command_line = ""


class InterruptedRunError(PagasError):
    """Ctrl-C; the message says what is kept and how to go on."""

    exit_status = 130


class NothingRefinedError(PagasError):
    """The work is done and nothing was refined: what was written is what came in."""

    exit_status = 3


class NothingRefinedWarning(UserWarning):
    """Of many views no depth was refined, or hardly one; the message names the likeliest reason."""


class DeviceError(PagasError, RuntimeError):
    """No OpenCL device can do the work: none found, too little memory, lost during the run."""


class NoDeviceError(DeviceError):
    """There is no OpenCL device to begin with, or none of the requested name."""

    exit_status = 2


class DeviceMemoryError(DeviceError):
    """The device cannot hold what the work needs; a plan with fewer buffers may do."""


class DeviceLostError(DeviceError):
    """The device has failed in the middle of work: lost, reset, or stopped by its driver."""


class KernelBuildError(DeviceError):
    """The device's compiler refused a kernel: `log` has its own words, `options` the build options that were passed,
    `source` the source as it saw it, includes pasted."""

    def __init__(self, message: str, log: str = "", options: str = "", source: str = ""):
        super().__init__(message)
        self.log, self.options, self.source = log, options, source


class OutputError(PagasError, OSError):
    """A result cannot be written: disk full, no permission, no such folder."""


class MissingExtraError(PagasError, ImportError):
    """An optional package is needed and absent; the message gives the pip command."""

    exit_status = 2

    def __init__(self, package: str, extra: str, purpose: str):
        super().__init__(f'{purpose} needs {package}, which is not installed: pip install "pagas-cl[{extra}]"')
        self.package, self.extra = package, extra


class UnloadableError(PagasError, ImportError):
    """An optional package is installed and cannot be loaded; the message says why, and what to do."""

    def __init__(self, package: str, purpose: str, cause: BaseException):
        while cause.__cause__ is not None:      # packages raise errors of their own over the loader's
            cause = cause.__cause__
        reason = " ".join(str(cause).split()) or type(cause).__name__
        remedy = next(advice for sign, advice in _REMEDIES if sign in reason)
        super().__init__(f"{purpose} needs {package}, which is installed and cannot be loaded ({reason}): {remedy}")
        self.package = package


# what the dynamic loader and Python say where a package's own code cannot be loaded, and what to do
_NO_MEMORY = "too little memory is left for it: raise the limit (ulimit -v, a container's), or free some"
_REMEDIES = (("cannot open shared object", "a system library is absent: apt-get install libusb-1.0-0 libgl1 libgomp1 "
                                           "libx11-6 libopengl0"),
             ("failed to map segment", _NO_MEMORY), ("annot allocate memory", _NO_MEMORY), ("MemoryError", _NO_MEMORY),
             ("No module named", "a package that it needs is absent: pip install it, or this one again"),
             ("", "install it again: pip install --force-reinstall"))


def need(package: str, extra: str, purpose: str) -> Any:
    """Import and return an optional `package`.

    MissingExtraError, naming the `extra` that brings it, where it is not installed; UnloadableError where it is and
    cannot be loaded.
    """
    try:
        return import_module(package)
    except (ImportError, OSError, MemoryError, RuntimeError) as error:
        if isinstance(error, ModuleNotFoundError) and error.name == package:
            raise MissingExtraError(package, extra, purpose) from error
        raise UnloadableError(package, purpose, error) from error
