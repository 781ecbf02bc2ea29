"""Why no OpenCL platform is found, in one sentence a user can act on.

An OpenCL loader (libOpenCL) finds drivers by small text files `*.icd`, each of which names a library.
"""

import glob
import os
import re
import shutil
import subprocess
import sys
from ctypes.util import find_library
from pathlib import Path

INTEL = 'pip install "pagas-cl[cpu]" (Intel\'s runtime for any x86-64 processor, under Intel\'s licence)'


def cpu_advice() -> str:
    """What to install on this system to have an OpenCL device."""
    return f"For the CPU: {_packager()}. For a GPU: its vendor's OpenCL driver."


def _packager() -> str:
    if sys.platform == "darwin":
        return "conda install -c conda-forge pyopencl pocl"
    if sys.platform == "win32":
        return f"{INTEL}, or conda install -c conda-forge pyopencl pocl"
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
    searched = "; ".join(f"{folder} ({_content(folder)})" for folder in search_folders())
    parts = ["no OpenCL platform found" + (f" ({reason})" if reason else ""), f"searched {searched}"]
    if "OCL_ICD_VENDORS" in os.environ:
        parts.append(f"OCL_ICD_VENDORS is set to {os.environ['OCL_ICD_VENDORS']!r} and replaces the usual folder, "
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
    if any("AMD" in name or "Accelerated Parallel" in name for name in platforms):
        message += "; may you read /dev/kfd? Add your user to the groups render and video, then log in again"
    if "Portable Computing Language" in platforms:
        message += "; PoCL needs a cache folder that it can write: name one with XDG_CACHE_HOME"
    if "POCL_CACHE_DIR" in os.environ:
        message += f"; POCL_CACHE_DIR is set to {os.environ['POCL_CACHE_DIR']!r}, which must be writable"
    if "POCL_DEVICES" in os.environ:
        message += f"; POCL_DEVICES is set to {os.environ['POCL_DEVICES']!r}, unset it"
    return f"{message}. {cpu_advice()}"


def search_folders() -> list[str]:
    """Folders (or files) where the loader looks for drivers."""
    folders = [os.environ.get("OCL_ICD_VENDORS") or "/etc/OpenCL/vendors"]
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
