"""The pyopencl module, with the drivers that it may load: Intel's CPU runtime where pip has installed it, none that
crashes.

An OpenCL loader finds drivers by files *.icd in one folder. Intel's packages put theirs beside the libraries of Python,
with a path that does not exist; so a folder of our own takes the system's files and one that names the library where it
is. A user who sets OCL_ICD_VENDORS has chosen, and nothing is done.
"""

import atexit
import ctypes
import os
import shutil
import sys
import tempfile
from functools import cache as cached
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from types import ModuleType

from pagas_cl.errors import DeviceError, NoDeviceError, log
from pagas_cl.runtime import cache, icd

VARIABLE = "OCL_ICD_VENDORS"
_INTEL, _LIBRARY, _THREADS = "intel-opencl-rt", "libintelocl.so", "libtbb.so.12"


_process: list[int] = []      # the process whose drivers were asked first


def import_pyopencl() -> ModuleType:
    """The pyopencl module, or a NoDeviceError that says what is wrong with it."""
    check_process()
    register()
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
    whatever it asks of them waits for ever."""
    if _process and _process[0] != os.getpid():
        raise DeviceError("this process was forked from one that had used OpenCL, whose drivers do not survive that: "
                          "start it with multiprocessing.get_context('spawn'), as in ProcessPoolExecutor(4, "
                          "multiprocessing.get_context('spawn')), or use no device before the fork")


def register() -> None:
    """Have the loader find the system's drivers and Intel's from pip.

    It looks when it is first asked: later calls change nothing in this process.
    """
    replace_cache()
    intel = None if VARIABLE in os.environ or not sys.platform.startswith("linux") else intel_library()
    if intel and not any(_LIBRARY in Path(name).read_text(errors="replace") for name in icd.system_files()):
        os.environ[VARIABLE] = folder_of(icd.system_files(), {"pagas_cl-intel-cpu.icd": f"{intel}\n"})
    for name in icd.icd_files() if sys.platform.startswith("linux") else ():
        if _LIBRARY in (text := Path(name).read_text(errors="replace")):
            _prefer_threads_beside(Path(text.strip()))


def _prefer_threads_beside(driver: Path) -> None:
    """Where Open3D or pymeshlab is imported before, its older libtbb has the name that Intel's driver asks for, which
    then cannot be loaded: the driver's own goes first where everything looks. What is loaded stays bound as it is."""
    if (driver.parent / _THREADS).is_file() and _THREADS in Path("/proc/self/maps").read_text():
        ctypes.CDLL(str(driver.parent / _THREADS), mode=ctypes.RTLD_GLOBAL)


@cached
def replace_cache() -> None:
    """Where the user's cache cannot be written PoCL has no device, and pyopencl fails: a folder of ours, then."""
    try:
        cache.folder().mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=cache.folder()):
            pass
    except OSError as error:
        log.warning("%s cannot be written (%s): the device is tried and its kernels are compiled anew in every run; "
                    "name another folder with XDG_CACHE_HOME", cache.folder(), error.strerror or error)
        os.environ["XDG_CACHE_HOME"] = tempfile.mkdtemp(prefix="pagas_cl-cache-")
        atexit.register(_remove, os.environ["XDG_CACHE_HOME"], os.getpid())


def _remove(folder: str, process: int) -> None:
    if os.getpid() == process:
        shutil.rmtree(folder, ignore_errors=True)


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
