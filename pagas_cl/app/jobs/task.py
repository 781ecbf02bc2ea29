"""What is sent to a worker and what comes back, small and free of arrays; and what makes two tasks the same."""

import json
import os
import pickle
import socket
from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import Enum
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from pagas_cl.config import Config
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.choice import Partners
from pagas_cl.scene.view import View
from pagas_cl.system.files import digest_file, digest_of

_OTHER_SETTINGS = ("context", "fusion")     # partners are named in the key; fusing comes after


@dataclass(frozen=True)
class ViewTask:
    """One view to refine."""

    name: str
    stem: str             # what its files are called, below the folder of the run
    partners: Partners    # places in Batch.views
    depth: Any            # the initial depth map: an object with load() and digest
    key: str              # see task_key

    def failed(self, error: str, fault: "Fault") -> "Record":
        """The record of a view that could not be refined."""
        return Record(self.name, self.stem, self.key, error=error, fault=fault)


class Fault(str, Enum):
    """Why a view could not be refined. Only what is LOST is tried again: all else would come again."""

    INPUT = "input"       # its photo, mask or depth map
    MEMORY = "memory"     # the device cannot hold what it needs
    LOST = "lost"         # a worker or its device failed: another attempt may not meet it
    OTHER = "other"


@dataclass(frozen=True)
class Record:
    """What is known of one view when it is done."""

    name: str
    stem: str
    key: str
    reason: str = ""                               # why it was kept unchanged; empty where it was refined
    counts: dict = field(default_factory=dict)     # pixels refined, kept, rejected, without surface
    report: dict = field(default_factory=dict)     # DepthResult.report, and the device and worker
    digests: dict = field(default_factory=dict)    # sums (scene.files.sum_of) of the files that belong to it
    error: str = ""                                # what went wrong, one sentence; empty where the view is done
    fault: Fault | None = None                     # of which kind that is


@cache
def code_version() -> str:
    """Hash of the whole package: a list of what can change a depth map would be wrong one day."""
    return digest_of(part for name, content in sorted(sources().items()) for part in (f"{name}\n".encode(), content))


def sources() -> dict[str, bytes]:
    """Every file of Python and OpenCL that is installed, by its name in the wheel."""
    found = {}
    for package in ("pagas_cl", "pagas_cl.cl_kernels", "pagas_cl.filters"):    # next to one another in a checkout
        found.update(_sources_below(files(package), package.replace(".", "/")))
    return found


def _sources_below(folder, name: str) -> Iterator[tuple[str, bytes]]:
    for item in folder.iterdir():
        if item.is_dir():
            yield from _sources_below(item, f"{name}/{item.name}")
        elif item.name.endswith((".py", ".cl", ".clh")):
            yield f"{name}/{item.name}", item.read_bytes()


def view_digest(view: View) -> str:
    """Hash of a view whose photo and mask are on disk: their content, the camera, the name."""
    return _digest_json([view.name, *_numbers(view.camera), *map(_source_digest, (view.image, view.mask))])


def task_key(partners: Partners, digests: dict[int, str], depth_digest: str, config: Config, work) -> str:
    """Hash of one view's inputs, settings and code; `digests` by place, `work` the function that does it."""
    settings = {name: value for name, value in config.as_dict().items() if name not in _OTHER_SETTINGS}
    return _digest_json([code_version(), f"{work.__module__}.{work.__qualname__}", depth_digest,
                         [digests[index] for index in partners.all], len(partners.contexts), partners.reason, settings])


def _digest_json(parts: list) -> str:
    return digest_of([json.dumps(parts).encode()])


def _numbers(camera: Camera) -> list:
    numbers = [camera.fx, camera.fy, camera.cx, camera.cy, *camera.world_to_camera.ravel().tolist()]
    return [camera.width, camera.height, *(float(number).hex() for number in numbers)]


def _source_digest(source) -> str:
    if source is None or hasattr(source, "digest"):
        return getattr(source, "digest", "")
    if isinstance(source, Path):
        return digest_file(source)
    return digest_file(source.path) + digest_of([pickle.dumps(source, protocol=4)])    # a lens, and a path


def worker_name() -> str:
    """Machine and process."""
    return f"{_machine()}-{os.getpid()}"


_machine = cache(socket.gethostname)      # a system call, which lets other threads go first


def on_a_line(name: str) -> str:
    """A view's name on one line of any text file, whatever characters it has."""
    return name.encode("unicode_escape").decode()
