"""What the command line sets in its own process. As a library pagas_cl sets none of it."""

import atexit
import os
import shutil
import tempfile

from pagas_cl.errors import log
from pagas_cl.runtime import cache, host
from pagas_cl.runtime.device import Device, open_device


def opened_device(name: str | None) -> Device:
    """As open_device; from here on the process keeps the memory of freed arrays where that suits the device."""
    device = open_device(name)
    host.keep_freed(device.info.kind != "CPU")       # whose memory is the host's
    return device


def replace_cache() -> None:
    """Where the user's cache folder cannot be written PoCL has no device, and pyopencl does not compile: another folder
    for this process and its children (XDG_CACHE_HOME), removed when it ends."""
    try:
        cache.folder().mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=cache.folder()):
            pass
    except OSError as error:
        log.warning("%s cannot be written (%s): the device is tried and its kernels are compiled anew in every run; "
                    "name another folder with XDG_CACHE_HOME", cache.folder(), error.strerror or error)
        folder = tempfile.mkdtemp(prefix="pagas_cl-cache-")
        os.environ["XDG_CACHE_HOME"] = folder
        atexit.register(_remove, folder, os.getpid())


def _remove(folder: str, process: int) -> None:
    if os.getpid() == process:
        shutil.rmtree(folder, ignore_errors=True)
