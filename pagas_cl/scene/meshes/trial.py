"""Loading a mesh file by pymeshlab for files.check_mesh_file, in a process that may crash, hang or fill memory."""

import os
import sys

from pagas_cl.errors import need
from pagas_cl.system import child

_ROOM, _TIMES = 1 << 30, 60      # bytes that loading may take, and of every byte of the file


def load(path: str) -> dict[str, str]:
    """{"fault": why it cannot be loaded, or empty}."""
    pymeshlab = need("pymeshlab", "meshlab", "loading a mesh into MeshLab's filters")
    _limit(_ROOM + _TIMES * os.path.getsize(path))
    fault = ""
    try:
        pymeshlab.MeshSet().load_new_mesh(path)
    except MemoryError:
        fault = "it takes more memory than a file of its size has use for"
    except (pymeshlab.PyMeshLabException, RuntimeError) as error:
        fault = (str(error).strip().splitlines() or ["no reason given"])[0][:200]
    return {"fault": fault}


def _limit(more: int) -> None:
    """From now on this process may take `more` bytes; on Linux, other systems do not hold to such limits."""
    if sys.platform == "linux":
        import resource

        with open("/proc/self/statm") as file:
            taken = int(file.read().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (taken + more, taken + more))


if __name__ == "__main__":
    child.answer(load)
