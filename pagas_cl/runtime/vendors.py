"""The pyopencl module, and the drivers that OpenCL's loader finds: the system's, and Intel's CPU runtime from pip.

An OpenCL loader finds drivers by files *.icd in one folder, which the environment variable OCL_ICD_VENDORS replaces. It
reads the variable when platforms are first listed, and never again. Intel's packages put their file next to the
libraries of Python, with a path that does not exist; so a folder made here has copies of the system's files and one
that names the library where it is. The variable is set while platforms are listed and then restored (`registered`). A
user who has set it has chosen, and nothing is done.
"""

import ctypes
import os
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from types import ModuleType

from pagas_cl.errors import DeviceError, NoDeviceError
from pagas_cl.runtime import cache, icd

VARIABLE = "OCL_ICD_VENDORS"
_INTEL, _LIBRARY, _THREADS = "intel-opencl-rt", "libintelocl.so", "libtbb.so.12"

_environment_lock = threading.RLock()      # two threads may list platforms
_process: list[int] = []      # the process that was the first to use drivers


def import_pyopencl() -> ModuleType:
    """The pyopencl module, or a NoDeviceError that says what is wrong with it."""
    check_process()
    try:
        import pyopencl
    except ImportError as error:
        raise NoDeviceError(icd.no_pyopencl(error)) from error
    return pyopencl


def begin_process() -> None:
    """From here on the drivers run threads of their own in this process."""
    _process[:] = [os.getpid()]


def check_process() -> None:
    """Raise DeviceError in a process that was forked from one in which drivers run: their threads are not in it, and
    whoever calls them waits for ever."""
    if _process and _process[0] != os.getpid():
        raise DeviceError("this process was forked from one that had used OpenCL, whose drivers do not survive that: "
                          "start it with multiprocessing.get_context('spawn'), as in ProcessPoolExecutor(4, "
                          "multiprocessing.get_context('spawn')), or use no device before the fork")


@contextmanager
def registered() -> Iterator[None]:
    """Context in which platforms are first listed: the loader finds the system's drivers and Intel's from pip.

    For callers who list platforms by pyopencl before they call pagas_cl, too. Child processes that are started
    meanwhile inherit the variable.
    """
    with setting(_folder_with_intel()):
        for name in icd.icd_files() if sys.platform.startswith("linux") else ():
            text = Path(name).read_text(errors="replace")
            if _LIBRARY in text:
                _prefer_threads_of(Path(text.strip()))
        yield


@contextmanager
def setting(value: str | None) -> Iterator[None]:
    """Context in which OCL_ICD_VENDORS is `value`, or unchanged where that is None; restored at its end."""
    with _environment_lock:
        before = os.environ.get(VARIABLE)
        if value is not None:
            os.environ[VARIABLE] = value
        try:
            yield
        finally:
            if before is not None:
                os.environ[VARIABLE] = before
            else:
                os.environ.pop(VARIABLE, None)


def _folder_with_intel() -> str | None:
    """A folder with the system's drivers and Intel's from pip; None where there is none, the system has it already, or
    the user has set the variable."""
    intel = None if VARIABLE in os.environ or not sys.platform.startswith("linux") else intel_library()
    if intel is None or any(_LIBRARY in Path(name).read_text(errors="replace") for name in icd.system_files()):
        return None
    return folder_of(icd.system_files(), {"pagas_cl-intel-cpu.icd": f"{intel}\n"})


def _prefer_threads_of(driver: Path) -> None:
    """Where Open3D or pymeshlab is imported before, its older libtbb has the name that Intel's driver looks for, which
    then cannot be loaded: the driver's own goes first in every search. What is loaded stays bound unchanged."""
    if (driver.parent / _THREADS).is_file() and _THREADS in Path("/proc/self/maps").read_text():
        ctypes.CDLL(str(driver.parent / _THREADS), mode=ctypes.RTLD_GLOBAL)


def folder_of(names: list[str], more: dict[str, str] | None = None) -> str:
    """A folder that holds copies of the .icd files `names`, and `more` (name -> text); made once for each such set."""
    files = {Path(name).name: Path(name).read_text(errors="replace") for name in names} | (more or {})
    folder = cache.folder() / "vendors" / cache.digest(files)
    try:
        _fill(folder, files)
    except OSError:
        folder = Path(tempfile.mkdtemp(prefix="pagas_cl-vendors-"))      # of this process alone
        _fill(folder, files)
    return str(folder)


def intel_library() -> Path | None:
    """Intel's OpenCL driver for CPUs, where pip has installed it with all that it loads; else None."""
    try:
        files = distribution(_INTEL).files or ()
    except PackageNotFoundError:
        return None
    paths = [Path(str(file.locate())).resolve() for file in files if file.name == _LIBRARY]
    return next((path for path in paths if path.is_file() and (path.parent / "libimf.so").is_file()), None)


def intel_is_incomplete() -> bool:
    """Whether Intel's driver is installed without the package that it takes its mathematics from."""
    try:
        distribution(_INTEL)
    except PackageNotFoundError:
        return False
    return intel_library() is None


def _fill(folder: Path, files: dict[str, str]) -> None:
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    for name, text in files.items():
        path = folder / name
        if not path.is_file() or path.read_text(errors="replace") != text:
            cache.write_whole(path, text)
