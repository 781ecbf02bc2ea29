"""Which views go together, and in what order: neighbours share photos."""

from collections.abc import Callable, Collection
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, replace

import numpy as np

from pagas_cl.config import Config
from pagas_cl.errors import InputError
from pagas_cl.jobs.keeping import EarlierResults, Results
from pagas_cl.jobs.task import ViewTask, task_key, view_digest
from pagas_cl.runtime.host import side_by_side
from pagas_cl.scene.choice import PartnerChooser, Partners
from pagas_cl.scene.names import file_stems
from pagas_cl.scene.view import View

_BATCH = 16      # most views in a batch
_HERE = 64       # views in a batch of this process: between two of them the device waits
_THREADS = 2     # that choose partners: each of many short calls of NumPy waits for Python's lock
_SHARES = 8      # batches for each worker, so that a slow one leaves its share to others


@dataclass(frozen=True, eq=False)
class Batch:
    """Neighbouring views that one worker refines one after another, so that it reads the photos they share once."""

    work: Callable      # of a module: (views, partners, depth, config, device, photos, on_step or None) -> DepthResult
    views: dict[int, View]      # every one that the tasks need; for other processes with photos and masks on disk
    digests: dict[int, str]     # of each: equal ones are the same view
    tasks: tuple[ViewTask, ...]
    config: Config
    results: Results          # where they go
    keep: Callable | None = None    # (owner, result, device, photos): has what the next round needs stay there


class Planner:
    """Makes one view's task after another, so that workers have begun long before the last one is planned. `samples`
    are for scene.choice. `has_digests`: photos, masks and `depths` are on disk and hashed, so that a task is known
    again by a later run."""

    def __init__(self, views: list[View], depths: list, samples: list, config: Config, work, has_digests: bool = True):
        self.views, self._depths, self._config, self._work = views, depths, config, work
        self._has_digests = has_digests
        self._chooser = PartnerChooser([view.camera for view in views], samples, config.context)
        self.stems = file_stems([view.name for view in views]) if has_digests else [str(k) for k in range(len(views))]
        self._digests, self._partners, self._keys = {}, {}, {}
        self._earlier = None

    def choose_all(self, requested: Collection[int]) -> None:
        """Choose the partners of all views `requested` at once, and forget the depth maps."""
        side_by_side(self.partners, requested, _THREADS)
        self._chooser = None

    def after(self, results: Results, refined: Collection[int], work) -> "Planner":
        """Of the round after this one, which leaves `results` of the views `refined`."""
        planner = copy(self)
        planner._earlier, planner._keys, planner._work = (self, results, set(refined)), {}, work
        return planner

    def partners(self, index: int) -> Partners:
        if index not in self._partners:
            self._partners[index] = self._chooser.choose(index)
        return self._partners[index]

    def task(self, index: int) -> ViewTask:
        partners, depth, key = self.partners(index), self._given(index), self.stems[index]
        if self._has_digests:
            key = task_key(partners, {k: self.digest(k) for k in partners.all}, depth.digest, self._config, self._work)
        return ViewTask(self.views[index].name, self.stems[index], partners, depth, key)

    def _given(self, index: int):
        """What the view starts from: its depth map, or what the round before has left of it and its context views."""
        if self._earlier is None:
            return self._depths[index]
        before, results, refined = self._earlier
        return EarlierResults(results, tuple((self.views[k].camera, self.stems[k], before._key(k))
                                             for k in self.partners(index).refined(refined)))

    def _key(self, index: int) -> str:
        if index not in self._keys:
            self._keys[index] = self.task(index).key
        return self._keys[index]

    def hash_inputs(self, indices: Collection[int]) -> None:
        """Read what the keys of these views' tasks are made of; faults are raised where a key is made."""
        if not self._has_digests:
            return

        def hash_one(index: int) -> None:
            with suppress(InputError):
                self.digest(index), getattr(self._depths[index], "digest", None)

        side_by_side(hash_one, {k for index in indices for k in self.partners(index).all})

    def digest(self, index: int) -> str:
        """Hash of a view's photo, mask and camera, read once; its place where nothing is hashed."""
        if index not in self._digests:
            self._digests[index] = view_digest(self.views[index]) if self._has_digests else str(index)
        return self._digests[index]

    def batch(self, tasks, template: Batch) -> Batch:
        needed = sorted({index for task in tasks for index in task.partners.all})
        return replace(template, tasks=tuple(tasks), views={k: self.views[k] for k in needed},
                       digests={k: self.digest(k) for k in needed})


def groups(requested: list[int], views: list[View], workers: int) -> list[list[int]]:
    """Views that go together, in the order in which to give them out: a curve through the camera centres is cut into
    one stretch a worker (0: this process alone), and each worker that keeps pace goes along a stretch of its own."""
    if not requested:
        return []
    order = np.asarray(requested)[along_curve([views[index].camera.center for index in requested])]
    size = int(np.clip(len(requested) // (workers * _SHARES), 1, _BATCH)) if workers else _HERE
    stretches = [[part[start:start + size].tolist() for start in range(0, len(part), size)]
                 for part in np.array_split(order, max(1, workers))]
    longest = max(map(len, stretches))
    return [stretch[k] for k in range(longest) for stretch in stretches if k < len(stretch)]


def along_curve(points) -> np.ndarray:
    """Order of points along a Morton curve, which keeps neighbours together: intp of shape (N,)."""
    points = np.asarray(points, np.float64).reshape(-1, 3)
    low, span = points.min(axis=0), max(float(np.ptp(points, axis=0).max()), 1e-300)
    cell = ((points - low) / span * 1023).astype(np.int64)
    bits = (cell[:, None] >> np.arange(10)[:, None]) & 1      # (N, bit, axis)
    key = (bits.reshape(len(points), 30) << np.arange(30)).sum(axis=1)
    return np.argsort(key, kind="stable")
