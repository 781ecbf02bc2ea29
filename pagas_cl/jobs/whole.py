"""From views and depth maps to refined depth maps, by this process or by any executor, in rounds."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pagas_cl.config import Config
from pagas_cl.errors import InputError, log
from pagas_cl.jobs.collect import Collect, Scene
from pagas_cl.jobs.executors import Workers
from pagas_cl.jobs.finished import in_memory
from pagas_cl.jobs.keeping import Keeping, KeptInFolder, KeptInMemory, Results
from pagas_cl.jobs.plan import Batch, Planner, groups
from pagas_cl.jobs.run import RunByWorkers, run_here
from pagas_cl.jobs.task import Record, ViewTask
from pagas_cl.jobs.worker import Worker
from pagas_cl.method.splat.budget import check_device_memory
from pagas_cl.progress import NONE, Progress, stage
from pagas_cl.result import DepthResult
from pagas_cl.runtime.device import is_remote, open_device
from pagas_cl.runtime.host import side_by_side
from pagas_cl.scene.check.reasons import warn_of_nothing
from pagas_cl.scene.choice import for_planning
from pagas_cl.scene.images import Loads
from pagas_cl.scene.view import View

if TYPE_CHECKING:
    from pagas_cl.method.splat import PhotoStore
    from pagas_cl.method.view.rounds import Round


def refine_all(work: Callable[..., DepthResult], views: Sequence[View], depths: Sequence[Any],
               requested: Collection[int], config: Config, *, device: Any = None, executor: Any = None,
               folder: str | Path | None = None, extras: bool = True, progress: Progress = NONE,
               on_view: Callable[..., Any] | None = None,
               later: Sequence[Round] = (), photos: PhotoStore | None = None, at: str = "") -> list[Any]:
    """Refine the views `requested`, going on from what an earlier run has finished in `folder`.

    Parameters
    ----------
    work : callable
        See plan.Batch.
    depths : list of (ndarray of shape (H, W), StoredArray, DepthSource, or None)
    device : str, sequence of str, Device, or None
        "all" and sequences: one process a device. With an executor: what each worker chooses from.
    executor : concurrent.futures.Executor, or the address of a Dask scheduler, optional
        This process alone where it is left out, and no several devices are named.
    folder : path, optional
        Gets `<stem>.npz` of each view and the work folder; every worker must see it. A run that finds finished views
        of the same inputs and settings there does not do them again. Results stay in memory where it is left out.
    extras : bool
        Whether status, deviation and parallax are kept in the folder.
    on_view : callable of (view, initial depth, result), optional
        Called in the order of `requested`, in which the results come too: StoredResult (DepthResult without a
        folder). A view that failed has no surface, and its error in `report["failed"]`.
    later : sequence of rounds.Round
        What is done after it, round by round, with each view's result and those of its context views. What the rounds
        before the last one leave is kept until all views are done.
    photos : PhotoStore, optional
        Photos that are on the one device already.
    at : str
        What progress calls this run, after its rounds' names, where another one follows, which warns where nothing
        was refined.
    """
    scene = Scene(views, depths, list(requested), on_view)

    def run(keeping: Keeping, place: Worker | Workers) -> list[Any]:
        try:
            return _Rounds(keeping, place, work, scene, config, progress, later, at).run()
        finally:
            place.close()

    kept = KeptInMemory() if folder is None else KeptInFolder(folder, len(later), extras)
    if not is_remote(executor, device):
        return run(kept, Worker(open_device(device) if photos is None else photos.device, photos))
    if folder is not None:
        return run(kept, Workers(executor, device))
    with tempfile.TemporaryDirectory(prefix="pagas_cl-") as temporary:
        results = run(KeptInFolder(temporary, len(later)), Workers(executor, device))
        return [in_memory(result) for result in results]


class _Rounds:
    """All rounds of a run."""

    def __init__(self, keeping: Keeping, place: Worker | Workers, work: Callable[..., DepthResult], scene: Scene,
                 config: Config, progress: Progress, later: Sequence[Round], at: str):
        self._keeping, self._place, self._scene, self._config = keeping, place, scene, config
        self._progress, self._works = progress, [work, *(step.work for step in later)]
        self._later, self._last, self._at = later, len(later), at
        self._failed: list[Record] = []

    def run(self) -> list[Any]:
        """The results, in the order of the views that are refined."""
        if isinstance(self._place, Worker):
            check_device_memory([view.camera for view in self._scene.views], self._config, self._place.device)
        with self._keeping.opened():
            planner, requested = self._planned()
            self._keeping.begin([planner.stems[index] for index in requested])
            wanted = self._wanted(planner, requested)
            for number in range(self._last):
                collect = self._round(number, planner, wanted[number], wanted[number], [])
                self._failed += collect.failed()      # takes no part in the next rounds
                lost = {record.stem for record in self._failed}
                remaining = [k for k in requested if planner.stems[k] not in lost]
                wanted[number + 1] = [k for k in wanted[number + 1] if k in remaining]
                planner = planner.after(self._keeping.results(number), remaining, self._works[number + 1])
                self._forget(number - 1)
            collect = self._round(self._last, planner, wanted[-1], requested, self._failed)
            found = [collect.result(index) for index in requested]
            if not self._at:
                warn_of_nothing(self._scene.views, self._scene.depths, found)     # which may read the depth maps
            self._keeping.end(complete=not collect.failed())
        return found

    def _forget(self, number: int) -> None:
        """Let go of what the device holds of a round whose results are used up."""
        if number >= 0 and isinstance(self._place, Worker):
            self._place.photos.forget(self._keeping.results(number).held())

    def _planned(self) -> tuple[Planner, list[int]]:
        """Who makes the first round's tasks, and places of the views that can be refined."""
        scene = self._scene
        samples, requested = _sampled(scene.depths, scene.requested)
        views, depths = self._keeping.inputs(scene.views, scene.depths)
        planner = Planner(views, depths, samples, self._config, self._works[0], self._keeping.has_digests)
        if any(isinstance(sample, np.ndarray) for sample in samples):       # few views: whole depth maps
            planner.choose_all(requested)
        return planner, requested

    def _wanted(self, planner: Planner, requested: list[int]) -> list[list[int]]:
        """Views that each round has to work on: all, or, where an earlier run has left results, those that are not
        finished, and before them those whose results they need."""
        rounds = range(self._last + 1)
        if not self._last or not any(self._keeping.earlier(number) for number in rounds):
            return [list(requested) for _ in rounds]
        last = planner
        for number in range(self._last):
            last = last.after(self._keeping.results(number), requested, self._works[number + 1])
        results = self._keeping.results(self._last)
        needed = {k for k in requested if not _is_finished(last, k, results)}
        wanted = [list(requested)]
        for _ in range(self._last):
            needed = {j for k in needed for j in planner.partners(k).refined(requested)}
            wanted.insert(0, [k for k in requested if k in needed])
        return wanted

    def _round(self, number: int, planner: Planner, wanted: list[int], shown: list[int],
               failed: list[Record]) -> Collect:
        """Work on the views `wanted` of those that are `shown`, some of which have `failed` before."""
        results = self._keeping.results(number)
        scene = self._scene if number == self._last else replace(self._scene, on_view=None)
        with stage(self._progress if shown else NONE, _name_of(number) + self._at, len(shown)) as progress:
            collect = Collect(shown, planner.stems, scene, results, progress)
            for record in failed:
                collect(record)
            self._work_through(number, planner, wanted, results, collect)
        collect.raise_if_all_failed()
        return collect

    def _work_through(self, number: int, planner: Planner, wanted: list[int], results: Results,
                      collect: Collect) -> None:
        following = self._later[number] if number < self._last else None
        looks = number == 0 or self._later[number - 1].photos
        template = Batch(self._works[number], {}, {}, (), self._config, results, photos=looks,
                         keep=following and following.keep)
        is_here = isinstance(self._place, Worker)
        parts = groups(wanted, self._scene.views, 0 if is_here else self._place.count())
        batches = self._unfinished(number, planner, parts, template, collect)
        if is_here:
            run_here(batches, self._place, collect)
        else:
            RunByWorkers(results, collect, self._place).finish(batches)

    def _unfinished(self, number: int, planner: Planner, parts: list[list[int]], template: Batch,
                    collect: Collect) -> Iterator[Batch]:
        """Batches of what no earlier run has finished, each planned when it is needed; where there was an earlier run
        all of them first, so that what is kept of it is reported before the work begins."""
        todos = (_todo(planner, part, template.results, collect) for part in parts)
        if self._keeping.earlier(number):
            todos = iter(list(todos))
            kept = sum(not record.error for record in collect.records.values())
            log.info("%d of %d views were finished by an earlier run and are kept%s", kept, len(collect.requested),
                     "" if kept else ": it had other inputs or settings, or another format of results")
        for todo in todos:
            if todo:
                collect.begin_batch()
                yield planner.batch(todo, template)


def _name_of(number: int) -> str:
    """What progress calls a round."""
    return f"agree, round {number}" if number else "refine"


def _is_finished(planner: Planner, index: int, results: Results) -> bool:
    try:
        return results.find(planner.task(index)) is not None
    except InputError:        # raised again when it is planned
        return False


def _todo(planner: Planner, part: list[int], results: Results, collect: Collect) -> list[ViewTask]:
    """The tasks of a part of the views, without those that are finished, which are collected."""
    todo = []
    planner.hash_inputs(part)
    for index in part:
        try:
            task = planner.task(index)
        except InputError as error:  # a photo that has gone meanwhile
            name = planner.views[index].name
            log.error("view %s is left out: %s", name, error)
            collect(Record(name, planner.stems[index], "", error=str(error), fault=InputError))
            continue
        record = results.find(task)
        if record is None:
            todo.append(task)
        else:
            collect(record)
    return todo


def _sampled(depths: Sequence[Any], requested: list[int]) -> tuple[list[Any], list[int]]:
    """What planning needs of each depth map, and which of the views `requested` have a valid depth."""
    def sample(depth: Any) -> Any:
        return for_planning(depth.load() if isinstance(depth, Loads) else depth, len(depths))

    samples = side_by_side(sample, depths)      # no more than these are in memory at a time
    valid = [k for k in requested if samples[k] is not None and (getattr(samples[k], "depth", samples[k]) > 0).any()]
    if not valid:
        raise InputError("no view has a depth map with a valid pixel: nothing to refine")
    if len(valid) < len(requested):
        log.warning("%d views have a depth map without a valid pixel and are left out", len(requested) - len(valid))
    return samples, valid
