"""The pyopencl module, and the drivers that OpenCL's loader finds: the system's, and Intel's CPU runtime from pip; why
it finds none, in one sentence that a user can act on.

An OpenCL loader (libOpenCL) finds drivers by files *.icd, each of which names a library, in one folder, which the
environment variable OCL_ICD_VENDORS replaces. It reads the variable when platforms are first listed, and never again.
Intel's packages put their file next to the libraries of Python, with a path that does not exist; so a folder made here
has copies of the system's files and one that names the library where it is. The variable is set while platforms are
listed and then restored (`registered`). A user who has set it has chosen, and nothing is done.
"""

import ctypes
import glob
import os
import re
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from ctypes.util import find_library
from importlib.metadata import PackageNotFoundError, PackagePath, distribution
from pathlib import Path
from types import ModuleType

from pagas_cl.errors import DeviceError, NoDeviceError
from pagas_cl.runtime import cache

VARIABLE = "OCL_ICD_VENDORS"
POCL = "Portable Computing Language"      # its platform's name
INTEL = 'pip install "pagas-cl[cpu]" (Intel\'s runtime for any x86-64 processor, under Intel\'s licence)'
_INTEL, _LIBRARY, _THREADS = "intel-opencl-rt", "libintelocl.so", "libtbb.so.12"

_environment_lock = threading.RLock()      # two threads may list platforms
_process: list[int] = []      # the process that was the first to use drivers


def import_pyopencl() -> ModuleType:
    """The pyopencl module, or a NoDeviceError that says what is wrong with it."""
    check_process()
    try:
        import pyopencl
    except ImportError as error:
        raise NoDeviceError(no_pyopencl(error)) from error
    return pyopencl


def begin_process() -> None:
    """From here on the drivers run threads of their own in this process."""
    _process[:] = [os.getpid()]


def check_process() -> None:
    """DeviceError in a process forked from one in which drivers run, whose threads it lacks: callers wait for ever."""
    if _process and _process[0] != os.getpid():
        raise DeviceError("this process was forked from one that had used OpenCL, whose drivers do not survive that: "
                          "start it with multiprocessing.get_context('spawn'), as in ProcessPoolExecutor(4, "
                          "multiprocessing.get_context('spawn')), or use no device before the fork")


@contextmanager
def registered() -> Iterator[None]:
    """Context in which platforms are first listed: the loader finds the system's drivers and Intel's from pip.

    Also for callers who list platforms by pyopencl first. Child processes that start meanwhile inherit the variable.
    """
    with setting(_folder_with_intel()):
        for name in icd_files() if sys.platform.startswith("linux") else ():
            text = Path(name).read_text(errors="replace")
            threads = Path(text.strip()).parent / _THREADS
            # Where Open3D or pymeshlab is imported before, its older libtbb has the name that Intel's driver looks for,
            # which then cannot be loaded: its own goes first in every search. What is loaded stays bound unchanged.
            if _LIBRARY in text and threads.is_file() and _THREADS in Path("/proc/self/maps").read_text():
                ctypes.CDLL(str(threads), mode=ctypes.RTLD_GLOBAL)
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
    """A folder with the system's drivers and Intel's from pip; None where the loader needs none."""
    intel = None if VARIABLE in os.environ or not sys.platform.startswith("linux") else intel_library()
    if intel is None or any(_LIBRARY in Path(name).read_text(errors="replace") for name in system_files()):
        return None
    return folder_of(system_files(), {"pagas_cl-intel-cpu.icd": f"{intel}\n"})


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
    paths = [Path(str(file.locate())).resolve() for file in _intel_files() or () if file.name == _LIBRARY]
    return next((path for path in paths if path.is_file() and (path.parent / "libimf.so").is_file()), None)


def intel_is_incomplete() -> bool:
    """Whether Intel's driver is installed without the package that it takes its mathematics from; known on Linux."""
    return sys.platform.startswith("linux") and _intel_files() is not None and intel_library() is None


def _intel_files() -> list[PackagePath] | None:
    """Files of the package of Intel's driver; None where it is not installed."""
    try:
        return distribution(_INTEL).files or []
    except PackageNotFoundError:
        return None


def _fill(folder: Path, files: dict[str, str]) -> None:
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    for name, text in files.items():
        path = folder / name
        if not path.is_file() or path.read_text(errors="replace") != text:
            cache.write_whole(path, text.encode())


def cpu_advice() -> str:
    """What to install on this system to have an OpenCL device."""
    return f"For the CPU: {_packager()}. For a GPU: its vendor's OpenCL driver."


def _packager() -> str:
    if sys.platform == "darwin":
        return "conda install -c conda-forge pyopencl pocl"
    if sys.platform == "win32":
        return ("conda install -c conda-forge pyopencl pocl, or "
                f"{INTEL} with OCL_ICD_FILENAMES set to the path of its intelocl64.dll")
    packagers = (("apt-get", "apt-get install pocl-opencl-icd"), ("dnf", "dnf install pocl"),
                 ("pacman", "pacman -S pocl"), ("conda", "conda install -c conda-forge pyopencl pocl"))
    here = [how for program, how in packagers if shutil.which(program)] or [packagers[-1][1]]
    return f"{' or '.join(here)}, or {INTEL}"


def no_pyopencl(error: ImportError) -> str:
    if getattr(error, "name", None) == "pyopencl":
        return "pyopencl is not installed: pip install pyopencl"
    message = f"pyopencl is installed but cannot be loaded ({error}): pip install --force-reinstall pyopencl"
    if sys.platform == "win32":
        library = find_library("OpenCL")
        message += f"; the OpenCL library found first is {library or 'none'}, an old one must be removed or updated"
    return message


def no_platform(reason: str = "") -> str:
    """What to say when the loader knows no platform: folders searched, what is in them, what to install."""
    parts = ["no OpenCL platform found" + (f" ({reason})" if reason else "")]
    if sys.platform.startswith("linux"):      # Windows has them in its registry, macOS its own alone
        parts.append("searched " + "; ".join(f"{folder} ({_content(folder)})" for folder in search_folders()))
    if VARIABLE in os.environ:
        parts.append(f"OCL_ICD_VENDORS is set to {os.environ[VARIABLE]!r} and replaces the usual folder, "
                     "unset it")
    if os.path.exists(search_folders()[0]):
        parts += [f"the loader says: {line}" for line in loader_complaints()[:1]]
    nvidia = _nvidia_library()
    if nvidia and not any("nvidia" in Path(name).read_text(errors="replace").lower() for name in icd_files()):
        parts.append(f"{nvidia} is here but no nvidia.icd: run 'mkdir -p /etc/OpenCL/vendors && "
                     "echo libnvidia-opencl.so.1 > /etc/OpenCL/vendors/nvidia.icd'")
    return "; ".join(parts) + ". " + cpu_advice()


def no_device(platforms: list[str]) -> str:
    message = f"the OpenCL platforms found have no device: {', '.join(platforms)}"
    amd = any("AMD" in name or "Accelerated Parallel" in name for name in platforms)
    if amd and sys.platform.startswith("linux"):
        message += "; may you read /dev/kfd? Add your user to the groups render and video, then log in again"
    if POCL in platforms:
        message += "; PoCL needs a cache folder that it can write: name one with XDG_CACHE_HOME"
    if "POCL_CACHE_DIR" in os.environ:
        message += f"; POCL_CACHE_DIR is set to {os.environ['POCL_CACHE_DIR']!r}, which must be writable"
    if "POCL_DEVICES" in os.environ:
        message += f"; POCL_DEVICES is set to {os.environ['POCL_DEVICES']!r}, unset it"
    return f"{message}. {cpu_advice()}"


def search_folders() -> list[str]:
    """Folders (or files) where the loader looks for drivers."""
    folders = [os.environ.get(VARIABLE) or "/etc/OpenCL/vendors"]
    package = getattr(sys.modules.get("pyopencl"), "__file__", None)  # no driver is looked for before it is imported
    if package:
        folders.append(str(Path(package).parent / ".libs"))  # where its wheel's own loader looks
    return folders


def system_files() -> list[str]:
    """Every *.icd file that the loader reads where OCL_ICD_VENDORS is not set, and whose library can be there."""
    names = sorted(glob.glob("/etc/OpenCL/vendors/*.icd"))
    if Path(sys.prefix, "conda-meta").is_dir():
        names += sorted(glob.glob(os.path.join(sys.prefix, "etc/OpenCL/vendors/*.icd")))
    return names


def icd_files() -> list[str]:
    """Every *.icd file in the folders searched."""
    return sorted(name for folder in search_folders() for name in glob.glob(os.path.join(folder, "*.icd")))


def _content(folder: str) -> str:
    if not os.path.exists(folder):
        return "does not exist"
    names = sorted(os.path.basename(name) for name in glob.glob(os.path.join(folder, "*.icd")))
    return ", ".join(names) if names else "no .icd file"


def _nvidia_library() -> str:
    """Path of NVIDIA's OpenCL library where it is installed, else an empty string."""
    return next(iter(glob.glob("/usr/lib/*/libnvidia-opencl.so.1") + glob.glob("/usr/lib*/libnvidia-opencl.so.1")), "")


def loader_complaints() -> list[str]:
    """The loader's own lines about driver libraries that it cannot open, from a child process."""
    if not icd_files():
        return []
    try:
        child = subprocess.run([sys.executable, "-c", "import pyopencl; pyopencl.get_platforms()"], timeout=20,
                               env={**os.environ, "OCL_ICD_DEBUG": "7"}, stdin=subprocess.DEVNULL,
                               capture_output=True, text=True, errors="replace")
    except (OSError, subprocess.TimeoutExpired):
        return []
    quoted = re.findall(r"(?:IDL: |ICD: )?'?([^'\n]*cannot open shared object[^'\n]*)", child.stderr)
    return sorted({line.rpartition("IDL: ")[2].strip(" ',") for line in quoted})
