"""From views and depth maps to refined depth maps in a folder, by any executor."""

import shutil
import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from pagas_cl.errors import InputError, PagasError, log
from pagas_cl.jobs.executors import Workers
from pagas_cl.jobs.finished import (
    StoredResult,
    claim_names,
    find_finished,
    one_run,
    records_in,
    round_folder,
    work_folder,
)
from pagas_cl.jobs.plan import Planner, groups, on_disk
from pagas_cl.jobs.run import Run
from pagas_cl.jobs.store import Store, translate_os_errors
from pagas_cl.jobs.task import Batch, Record, code_version
from pagas_cl.jobs.worker import STOP, close_worker_contexts
from pagas_cl.progress import ViewProgress, tell
from pagas_cl.result import DepthResult
from pagas_cl.runtime.host import side_by_side
from pagas_cl.scene.choice import for_planning
from pagas_cl.scene.depth_source import DepthSource
from pagas_cl.scene.reasons import warn_of_nothing


def refine_all(work, views, depths, asked, config, *, device=None, executor=None, folder=None, extras=True,
               progress=None, on_view=None, later=(), before=None) -> list:
    """Refine the views `asked`, resuming what an earlier run has finished.

    Parameters
    ----------
    work : callable
        See task.Batch.
    depths : list of (ndarray of shape (H, W), StoredArray, DepthSource, or None)
    device : str, sequence of str, Device, or None
        "all" and sequences: one process a device. With an executor: what each worker chooses from.
    executor : concurrent.futures.Executor, or the address of a Dask scheduler, optional
        This process alone where it is left out, and no several devices are asked for.
    folder : path, optional
        Gets `<stem>.npz` of each view and the work folder; every worker must see it. A run that finds finished views
        of the same inputs, settings and code there does not do them again. A temporary folder where it is left out.
    extras : bool
        Whether status, deviation and parallax are kept.
    on_view : callable of (view, initial depth, result), optional
        Called in the order of `asked`, in which the results come too: StoredResult (DepthResult without a folder). A
        view that failed three times has no surface, and its error in `report["failed"]`.
    later : sequence of rounds.Round
        What is done after it, round by round, with each view's result and those of its context views. What the rounds
        before the last one leave is in the work folder until all views are done.
    before : callable, optional
        See task.Batch; of the first round.
    """
    if folder is None:
        with tempfile.TemporaryDirectory(prefix="pagas_cl-") as temporary:
            results = refine_all(work, views, depths, asked, config, device=device, executor=executor, folder=temporary,
                                 progress=progress, on_view=on_view, later=later, before=before)
            return [result if isinstance(result, DepthResult) else result.loaded() for result in results]
    folder = Path(folder).resolve()
    with one_run(folder):
        return _refine_in(folder, work, views, depths, asked, config, device, executor, extras, progress, on_view,
                          later, before)


def _refine_in(folder, work, views, depths, asked, config, device, executor, extras, progress, on_view, later,
               before) -> list:
    store = Store(work_folder(folder) / "inputs")
    for depth in depths:
        file = depth.file if isinstance(depth, DepthSource) else None
        if isinstance(file, Path) and file.resolve().parent == folder:
            raise InputError(f"the depth maps to start from are in {str(folder)!r}, where the refined ones would go; "
                             "the next run would refine those: choose another folder")
    samples, asked = _sampled(depths, asked)
    depths = store.put_arrays(depths)
    planner = Planner(on_disk(views, store), depths, samples, config, work)
    if any(isinstance(sample, np.ndarray) for sample in samples):       # few views: whole depth maps
        planner.settle(asked)
    del samples
    claim_names(folder, [planner.stems[index] for index in asked])
    workers = Workers(executor, device)
    template = Batch(work, {}, {}, (), config, folder, workers.device, code_version(), extras, before=before)
    _make_ready(folder)
    runs, failed, wanted = [], [], _wanted(planner, asked, folder, extras, later)
    places = [*(round_folder(folder, number) for number in range(len(later))), folder]
    for number, (some, place) in enumerate(zip(wanted, places)):
        unfinished = max(0, len(some) - len(records_in(place)))      # told anew when it is planned
        tell(progress, "expect_some", _stage(number), unfinished, len(some), len(asked))
    try:
        for number, views_of_round in enumerate(wanted[:-1]):
            place = round_folder(folder, number)
            _make_ready(place)
            collect = _Collect(views_of_round, views, depths, place, progress, None, _stage(number))
            runs.append(Run(workers, place, collect, progress and collect.inside))
            to_here = replace(template, folder=place, extras=True, keep=later[number].keep)
            runs[-1].finish(_unfinished(planner, groups(views_of_round, views, workers.count()), to_here, collect,
                                        len(asked)))
            collect.results()        # raises where every view has failed
            failed += [record for record in collect.records.values() if record.error]
            lost = {record.name for record in failed}
            asked_next = [k for k in asked if views[k].name not in lost]
            wanted[number + 1] = [k for k in wanted[number + 1] if k in asked_next]
            planner = planner.after(place, asked_next, later[number].work)
            template = replace(template, work=later[number].work, photos=later[number].photos, before=None)
        collect = _Collect(asked, views, depths, folder, progress, on_view, _stage(len(later)))
        for record in failed:
            collect(record)
        runs.append(Run(workers, folder, collect, progress and collect.inside))
        runs[-1].finish(_unfinished(planner, groups(wanted[-1], views, workers.count()), template, collect,
                                    len(asked)))
    except _Ended as ended:
        raise ended.error from None
    finally:
        if workers.own:
            (runs[-1] if runs else Run(workers, folder, None)).close()
        close_worker_contexts()
    results = collect.results()
    if not any(record.error for record in collect.records.values()):
        side_by_side(partial(shutil.rmtree, ignore_errors=True),
                     work_folder(folder).glob("round_*"))      # of killed runs with other settings, too
    warn_of_nothing(views, depths, results)     # which may read the depth maps
    shutil.rmtree(store.folder, ignore_errors=True)
    return results


def _stage(number: int) -> str:
    """What progress calls a round."""
    return f"agree, round {number}" if number else "refine"


def _wanted(planner: Planner, asked, folder: Path, extras: bool, later) -> list[list[int]]:
    """Views that each round has to work on: all, or, where an earlier run has left finished views, those that are not
    finished, and before them those that they take results of."""
    wanted, places = [list(asked)], [round_folder(folder, number) for number in range(len(later))]
    if later and any(records_in(place) for place in (folder, *places)):
        last = planner
        for place, step in zip(places, later):
            last = last.after(place, asked, step.work)
        needed = {k for k in asked if not _is_finished(last, k, folder, extras)}
        for _ in later:
            needed = {j for k in needed for j in planner.partners(k).refined(asked)}
            wanted.insert(0, [k for k in asked if k in needed])
        return wanted
    return wanted * (len(later) + 1)


def _is_finished(planner: Planner, index: int, folder: Path, extras: bool) -> bool:
    try:
        return find_finished(folder, planner.task(index), extras) is not None
    except InputError:        # told of when it is planned
        return False


def _unfinished(planner: Planner, parts, template: Batch, collect: "_Collect", of: int):
    """Batches of what no earlier run has finished, each planned when it is asked for; where there was an earlier run
    all of them first, so that what is kept of it is told before the work begins."""
    todos = (_todo(planner, part, template, collect) for part in parts)
    earlier = len(records_in(template.folder))
    if earlier:
        todos = list(todos)
        collect.progress.expect(sum(map(len, todos)), of)
        kept = sum(not record.error for record in collect.records.values())
        log.info("%d of %d views were finished by an earlier run and are kept%s", kept, len(collect.asked),
                 "" if kept else ": it had other inputs, settings or code")
    for todo in todos:
        if todo:
            yield planner.batch(todo, template)


def _todo(planner: Planner, part, template: Batch, collect: "_Collect") -> list:
    """The tasks of a part of the views, without those that are finished, which are collected."""
    todo = []
    planner.hash_inputs(part)
    for index in part:
        try:
            task = planner.task(index)
        except InputError as error:  # a photo that has gone meanwhile
            name = planner.views[index].name
            log.error("view %s is left out: %s", name, error)
            collect(Record(name, "", "", error=str(error), bad_input=True))
            continue
        record = find_finished(template.folder, task, template.extras)
        if record is None:
            todo.append(task)
        else:
            collect(record)
    return todo


class _Ended(BaseException):
    """The caller's own error, on its way past those who take errors for a view's."""

    def __init__(self, error: Exception):
        super().__init__(str(error))
        self.error = error


class _Collect:
    """Takes the records as they come, tells of them in the order of the views."""

    def __init__(self, asked, views, depths, folder, progress, on_view, stage: str = "refine"):
        self.asked, self.views, self.depths, self.folder = asked, views, depths, folder
        self.progress, self.on_view = ViewProgress(progress, len(asked), stage), on_view
        self.records, self._told = {}, 0
        self.progress.at(0)

    def __call__(self, record) -> None:
        self.records[record.name] = record
        self.progress.at(len(self.records))
        while self.on_view and self._told < len(self.asked):
            index = self.asked[self._told]
            record = self.records.get(self.views[index].name)
            if record is None:
                break
            self._told += 1
            if record.key:  # it could be planned
                self.on_view(self.views[index], self.depths[index].load(), self._result(index))

    def inside(self, number: int):
        """Progress of view `number` of the batch at hand. What it raises is the caller's error, and ends the run."""
        tell = self.progress.inside(len(self.records) + number)

        def relay(*given):
            try:
                tell(*given)
            except Exception as error:
                raise _Ended(error) from error

        relay("", 0, 1)       # those before it are done
        return relay

    def results(self) -> list:
        failed = [record for record in self.records.values() if record.error]
        if failed and len(failed) == len(self.asked):
            kind = InputError if all(record.bad_input for record in failed) else PagasError
            raise kind(f"every view has failed; {failed[0].name}: {failed[0].error}")
        return [self._result(index) for index in self.asked]

    def _result(self, index: int):
        record, camera = self.records[self.views[index].name], self.views[index].camera
        if record.error:
            return DepthResult.missing(camera, record.error, record.name)
        return StoredResult(camera, self.folder, record)


def _sampled(depths, asked) -> tuple[list, list[int]]:
    """What planning needs of each depth map, and which of the views `asked` have a valid depth."""
    def sample(depth):
        return for_planning(depth.load() if hasattr(depth, "load") else depth, len(depths))

    samples = side_by_side(sample, depths)      # no more than these are in memory at a time
    valid = [k for k in asked if samples[k] is not None and (getattr(samples[k], "depth", samples[k]) > 0).any()]
    if not valid:
        raise InputError("no view has a depth map with a valid pixel: nothing to refine")
    if len(valid) < len(asked):
        log.warning("%d views have a depth map without a valid pixel and are left out", len(asked) - len(valid))
    return samples, valid


def _make_ready(folder: Path) -> None:
    """The folder without what killed runs have left."""
    work = work_folder(folder)
    for left in ("parts", "journal"):
        shutil.rmtree(work / left, ignore_errors=True)
    with translate_os_errors(folder):
        (work / STOP).unlink(missing_ok=True)
