"""From views and depth maps to refined depth maps, by this process or by any executor, in rounds."""

import tempfile
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pagas_cl.config import Config
from pagas_cl.errors import InputError, log, short
from pagas_cl.jobs.finished import in_memory
from pagas_cl.jobs.keeping import Keeping, Results
from pagas_cl.jobs.plan import Batch, Planner, groups
from pagas_cl.jobs.pools import Workers, workers_of
from pagas_cl.jobs.run import Collect, RunByWorkers, Scene, run_here
from pagas_cl.jobs.task import Record, ViewTask
from pagas_cl.jobs.work_folder import one_run
from pagas_cl.jobs.worker import Worker
from pagas_cl.method.splat import PhotoStore
from pagas_cl.method.splat.budget import check_device_memory
from pagas_cl.method.view.rounds import keep
from pagas_cl.progress import NONE, Progress, stage
from pagas_cl.result import DepthResult
from pagas_cl.runtime.device import is_remote, open_device
from pagas_cl.runtime.host import side_by_side
from pagas_cl.scene.check.reasons import warn_of_nothing
from pagas_cl.scene.choice import for_planning
from pagas_cl.scene.images import Loads
from pagas_cl.scene.inputs import NO_DEPTH
from pagas_cl.scene.view import View


def refine_all(work: Callable[..., DepthResult], views: Sequence[View], depths: Sequence[Any],
               requested: Collection[int], config: Config, *, device: Any = None, executor: Any = None,
               folder: str | Path | None = None, extras: bool = True, progress: Progress = NONE,
               on_view: Callable[..., Any] | None = None,
               later: Sequence[Callable[..., Any]] = (), photos: PhotoStore | None = None, at: str = "") -> list[Any]:
    """Refine the views `requested`, going on from what an earlier run has finished in `folder`.

    `work` as in plan.Batch; `later`: the same of the rounds after it, with each view's result and those of its context
    views (method.view.rounds). `depths`: arrays (H, W), what loads such, or None. Other parameters as in refine_views:
    with an executor, workers choose from `device` and all see the folder, which gets `<stem>.npz` of each view and the
    work folder. `photos`: those on the one device. `at`: what progress calls this run, after its rounds' names, where
    another one follows, which warns where nothing was refined. Results are StoredResult, DepthResult without a folder,
    in the order of `requested`; a view that failed has no surface, and its error in `report["failed"]`."""
    scene, rounds = Scene(views, depths, list(requested), on_view), [work, *later]

    def run(folder: str | Path | None, extras: bool, place: Worker | Workers) -> list[Any]:
        return _Run(Keeping(folder, len(rounds), extras), place, rounds, scene, config, progress, at).run()

    if not is_remote(executor, device):
        with closing(Worker(open_device(device) if photos is None else photos.device, photos)) as worker:
            return run(folder, extras, worker)
    with workers_of(executor, device) as workers:
        if folder is not None:
            return run(folder, extras, workers)
        with tempfile.TemporaryDirectory(prefix="pagas_cl-") as temporary:
            return [in_memory(result) for result in run(temporary, True, workers)]


class _Run:
    def __init__(self, keeping: Keeping, place: Worker | Workers, rounds: Sequence[Callable], scene: Scene,
                 config: Config, progress: Progress, at: str):
        self._keeping, self._place, self._rounds, self._last = keeping, place, rounds, len(rounds) - 1
        self._scene, self._config, self._progress, self._at = scene, config, progress, at

    def run(self) -> list[Any]:
        """The results, in the order of the views that are refined."""
        if isinstance(self._place, Worker):
            check_device_memory([view.camera for view in self._scene.views], self._config, self._place.device)
        with one_run(self._keeping.folder):
            planner, requested = self._planned()
            self._keeping.begin([planner.stems[index] for index in requested])
            wanted = self._wanted(planner, requested)
            failed: list[Record] = []
            for number in range(self._last):
                collect = self._round(number, planner, wanted[number], wanted[number], [])
                failed += collect.failed()      # takes no part in the next rounds
                lost = {record.stem for record in failed}
                remaining = [k for k in requested if planner.stems[k] not in lost]
                wanted[number + 1] = [k for k in wanted[number + 1] if k in remaining]
                planner = planner.after(self._keeping.rounds[number], remaining, self._rounds[number + 1])
                if number and isinstance(self._place, Worker):
                    self._keeping.rounds[number - 1].forget(self._place.photos)
            collect = self._round(self._last, planner, wanted[-1], requested, failed)
            if self._last and isinstance(self._place, Worker):
                self._keeping.rounds[-2].forget(self._place.photos)
            found = [collect.result(index) for index in requested]
            if not self._at:
                warn_of_nothing(self._scene.views, self._scene.depths, found)     # which may read the depth maps
            self._keeping.end(complete=not collect.failed())
        return found

    def _planned(self) -> tuple[Planner, list[int]]:
        """Who makes the first round's tasks, and places of the views that can be refined."""
        scene = self._scene
        samples, requested = _sampled(scene)
        views, depths = self._keeping.inputs(scene.views, scene.depths)
        planner = Planner(views, depths, samples, self._config, self._rounds[0],
                          has_digests=self._keeping.folder is not None)
        if any(isinstance(sample, np.ndarray) for sample in samples):       # few views: whole depth maps
            planner.choose_all(requested)
        return planner, requested

    def _wanted(self, planner: Planner, requested: list[int]) -> list[list[int]]:
        """Views that each round has to work on: all, or what earlier runs have not finished and what these need."""
        rounds = self._keeping.rounds
        if not self._last or not any(results.of_earlier_runs() for results in rounds):
            return [list(requested) for _ in rounds]
        last = planner
        for results, work in zip(rounds, self._rounds[1:]):
            last = last.after(results, requested, work)
        needed = {k for k in requested if not _is_finished(last, k, rounds[-1])}
        wanted = [list(requested)]
        for _ in range(self._last):
            needed = {j for k in needed for j in planner.partners(k).refined(requested)}
            wanted.insert(0, [k for k in requested if k in needed])
        return wanted

    def _round(self, number: int, planner: Planner, wanted: list[int], shown: list[int],
               failed: list[Record]) -> Collect:
        """Work on the views `wanted` of those that are `shown`, some of which have `failed` before."""
        results, is_last = self._keeping.rounds[number], number == self._last
        scene, place = self._scene if is_last else replace(self._scene, on_view=None), self._place
        template = Batch(self._rounds[number], {}, {}, (), self._config, results, None if is_last else keep)
        parts = groups(wanted, scene.views, 0 if isinstance(place, Worker) else place.count())
        name = f"agree, round {number}" if number else "refine"
        with stage(self._progress if shown else NONE, name + self._at, len(shown)) as progress:
            collect = Collect(shown, planner.stems, scene, results, progress)
            for record in failed:
                collect(record)
            batches = self._unfinished(planner, parts, template, collect)
            if isinstance(place, Worker):
                run_here(batches, place, collect)
            else:
                RunByWorkers(results, collect, place).finish(batches)
        failed = collect.failed()
        if failed and len(failed) == len(shown):
            raise failed[0].failure(f"every view has failed; {failed[0].name}: {failed[0].error}")
        return collect

    def _unfinished(self, planner: Planner, parts: list[list[int]], template: Batch,
                    collect: Collect) -> Iterator[Batch]:
        """Batches of what no earlier run has finished, each planned when it is needed; where there was an earlier run
        all of them first, so that what is kept of it is reported before the work begins."""
        todos = (_todo(planner, part, template.results, collect) for part in parts)
        if template.results.of_earlier_runs():
            todos = iter(list(todos))
            kept = sum(not record.error for record in collect.records.values())
            log.info("%d of %d views were finished by an earlier run and are kept%s", kept, len(collect.requested),
                     "" if kept else ": it had other inputs or settings, or another format of results")
        for todo in todos:
            if todo:
                yield planner.batch(todo, template)


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


def _sampled(scene: Scene) -> tuple[list[Any], list[int]]:
    """What planning needs of each depth map, and which of the views that are requested have a valid depth."""
    def sample(depth: Any) -> Any:
        return for_planning(depth.load() if isinstance(depth, Loads) else depth, len(scene.depths))

    samples = side_by_side(sample, scene.depths)      # no more than these are in memory at a time
    valid = [k for k in scene.requested
             if samples[k] is not None and (getattr(samples[k], "depth", samples[k]) > 0).any()]
    if not valid:
        raise InputError(NO_DEPTH)
    if without := [scene.views[k].name for k in scene.requested if k not in valid]:
        log.warning("%d views see no surface (their depth map, given or of the mesh, has no valid pixel) and are left "
                    "out: %s", len(without), ", ".join(map(short, without[:5])))
    return samples, valid
