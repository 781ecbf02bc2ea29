"""What is sent to a worker and what comes back, small and free of arrays; and what makes two tasks the same."""

import json
import os
import platform
from dataclasses import dataclass, field
from typing import Any

from pagas_cl.config import Config
from pagas_cl.config.version import __version__
from pagas_cl.errors import DeviceError, DeviceLostError, DeviceMemoryError, InputError, PagasError
from pagas_cl.scene.choice import Partners
from pagas_cl.scene.view import View, source_digest
from pagas_cl.system.files import digest_of

RESULTS_FORMAT = 7
"""Part of every task's key: raised when the same inputs and settings give other depth maps than before, or their files
another form (tests/jobs/test_results_format.py fails where it was forgotten)."""

FAULTS = (InputError, DeviceMemoryError, DeviceLostError, DeviceError)
"""Why a view could not be refined, the first that fits, or PagasError; of DeviceLostError it is tried again."""

_OTHER_SETTINGS = ("context", "fusion")     # partners are named in the key; fusing comes after


@dataclass(frozen=True)
class ViewTask:
    """One view to refine."""

    name: str
    stem: str             # what its files are called, below the folder of the run
    partners: Partners    # places in Batch.views
    depth: Any            # the initial depth map, in memory or an object with load() and digest
    key: str              # see task_key

    def failed(self, error: Exception) -> "Record":
        message = str(error) if isinstance(error, PagasError) else f"{type(error).__name__}: {error}"
        fault = next((kind for kind in FAULTS if isinstance(error, kind)), PagasError)
        return Record(self.name, self.stem, self.key, error=message, fault=fault)


@dataclass(frozen=True)
class Record:
    """What is known of one view when it is done."""

    name: str
    stem: str
    key: str
    reason: str = ""                               # why it was kept unchanged; empty where it was refined
    counts: dict = field(default_factory=dict)     # pixels refined, kept, rejected, without surface
    report: dict = field(default_factory=dict)     # DepthResult.report, and the device and worker
    digests: dict = field(default_factory=dict)    # sums (system.files.sum_of) of the files that belong to it
    error: str = ""                                # what went wrong, one sentence; empty where the view is done
    fault: type[PagasError] | None = None          # of which kind that is, see FAULTS

    def failure(self, message: str) -> PagasError:
        return (self.fault or PagasError)(message)


def results_version() -> str:
    """What workers and the run that they work for have in common: the version, and the format of its results."""
    return f"{__version__}, results format {RESULTS_FORMAT}"


def view_digest(view: View) -> str:
    """Hash of a view whose photo and mask are on disk: their content, the camera, the name."""
    camera = view.camera
    numbers = [camera.fx, camera.fy, camera.cx, camera.cy, *camera.world_to_camera.ravel().tolist()]
    return _digest_json([view.name, camera.width, camera.height, *(float(number).hex() for number in numbers),
                         *map(source_digest, (view.image, view.mask))])


def task_key(partners: Partners, digests: dict[int, str], depth_digest: str, config: Config, work) -> str:
    """Hash of one view's inputs and settings, of RESULTS_FORMAT and of the name of the function `work`."""
    settings = {name: value for name, value in config.as_dict().items() if name not in _OTHER_SETTINGS}
    return _digest_json([RESULTS_FORMAT, f"{work.__module__}.{work.__qualname__}", depth_digest,
                         [digests[index] for index in partners.all], len(partners.contexts), partners.reason, settings])


def _digest_json(parts: list) -> str:
    return digest_of([json.dumps(parts).encode()])


def worker_name() -> str:
    return f"{platform.node()}-{os.getpid()}"


def on_a_line(name: str) -> str:
    """A view's name on one line of any text file, whatever characters it has."""
    return name.encode("unicode_escape").decode()
