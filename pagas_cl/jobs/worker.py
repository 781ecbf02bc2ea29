"""What happens in a worker: a batch in, records out; device, kernels and photos stay for the next batch."""

import multiprocessing
import os
import socket
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from datetime import datetime
from functools import cache, partial
from multiprocessing.connection import wait
from threading import Lock, Thread

from pagas_cl.errors import DeviceError, DeviceLostError, InputError, OutputError, PagasError
from pagas_cl.jobs.finished import find_finished, work_folder, write_finished
from pagas_cl.jobs.store import translate_os_errors
from pagas_cl.jobs.task import Batch, Record, ViewTask, code_version
from pagas_cl.runtime.claim import claim_device, give_back
from pagas_cl.runtime.device import translate_cl_errors
from pagas_cl.runtime.host import trim

STOP = "stop"              # a file of this name in the work folder asks every worker to end after its present view
_READERS = min(6, os.cpu_count() or 6)      # photos that are decoded at a time
_WRITERS = 4               # results that are written, and views that are read, at a time, beside a device with memory
_one_at_a_time = Lock()    # tasks of one process share a device's queue
_worker_contexts: dict = {}
_lost: list[str] = []      # the view at which the device failed, until one is refined
_lost_ahead: set[str] = set()      # keys of tasks at which it failed while it was at the one before


class _LostAheadError(DeviceLostError):
    """The device was lost at the task that follows: the view that it was at is begun anew."""


class WorkerContext:
    """What a process keeps: the device with its compiled kernels, photos on the device, views by their content."""

    def __init__(self, device):
        from pagas_cl.splat import PhotoStore

        self.device, self.photos, self._views = device, PhotoStore(device), {}
        self.before: dict = {}      # what was found of the task that follows, by its key

    def views(self, batch: Batch) -> dict:
        """The batch's views, those of earlier batches as the same objects, so that their photos are found again."""
        return {k: self._views.setdefault(batch.digests[k], view) for k, view in batch.views.items()}


def follow_parent() -> None:
    """In a process of a pool: end when the one that started it has, however that came about. Its queue would wait for
    ever, and it would keep the device from the run that goes on."""
    _follow_parent(os.getpid())


@cache
def _follow_parent(_: int) -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        Thread(target=lambda: (wait([parent.sentinel]), os._exit(1)), daemon=True).start()


def _begin(code: str) -> None:
    follow_parent()
    if code != code_version():
        raise DeviceError(f"the worker on {socket.gethostname()} runs another version of pagas_cl than the one that "
                          "planned the run: install the same version everywhere")


def run_part(work: Callable, part, device, code: str):
    """`work(part, context)` with this process's device, which is opened anew where that has failed."""
    _begin(code)
    with _one_at_a_time:
        context = _worker_context(device)
        try:
            with translate_cl_errors(context.device, "a part of the work"):
                return work(part, context)
        except Exception:
            _worker_contexts.pop(device, None)
            raise


def run_batch(batch: Batch, inside=None) -> list[Record]:
    """Refine the views of `batch` that are not finished; one record each, which also tells of the view's error.

    The device refines one view while the files of the next are read and those of the one before are written.
    `inside(k)` is the progress of view `k`, where somebody in this process wants to know. OutputError (nothing can be
    written) and DeviceError (no device to work with) are raised: they are not the view's fault.
    """
    _begin(batch.code)
    with _one_at_a_time, ThreadPoolExecutor(_READERS) as readers, ThreadPoolExecutor(_WRITERS) as writer:
        context = _worker_context(batch.device)
        waiting = 1 if context.photos.on_host else _WRITERS
        views, ended, ahead = context.views(batch), [], {}
        for number, task in enumerate(batch.tasks):
            if (work_folder(batch.folder) / STOP).exists():
                break
            record = find_finished(batch.folder, task, batch.extras)
            if record is not None:
                ended.append(record)
                continue
            for one in batch.tasks[number:number + 1 + waiting]:
                if one.name not in ahead:
                    ahead[one.name] = _read_ahead(batch, one, views, readers)
            depth, ahead[task.name] = ahead[task.name], None
            following = [(one, ahead[one.name]) for one in batch.tasks[number + 1:number + 2]]
            ended.append(_attempt(batch, task, views, depth, writer, inside and inside(len(ended)), following))
            if len(ended) > waiting and isinstance(ended[-1 - waiting], Future):
                ended[-1 - waiting] = ended[-1 - waiting].result()     # no more than these wait to be written
        ended = [record.result() if isinstance(record, Future) else record for record in ended]
    trim()
    return ended


def _read_ahead(batch: Batch, task: ViewTask, views: dict, readers: ThreadPoolExecutor) -> Future:
    """Have the photos of `task` read, where they are wanted, and its depth map, which is what is promised."""
    depth = readers.submit(task.depth.load)
    for k in task.partners.all if batch.photos else ():
        _worker_context(batch.device).photos.read_ahead(views[k], readers)
    return depth


def _attempt(batch: Batch, task: ViewTask, views: dict, depth: Future, writer: ThreadPoolExecutor, progress, following):
    """The record of `task` if it fails, else what promises it: `writer` is to write the result. `following`: the task
    after it and its depth map, if there is one."""
    context, start = _worker_context(batch.device), time.perf_counter()
    ahead = {"before": context.before.pop(task.key, None), "meanwhile": partial(
        _find_ahead, batch, views, following, context)} if batch.before and not context.photos.on_host else {}
    note_down(batch.folder, "began", task.name)
    try:
        result = batch.work(views, task.partners, depth.result(), batch.config, context.device, context.photos,
                            progress, **ahead)
    except OutputError:
        raise
    except Exception as error:  # whatever it is, the other views must not suffer
        record = _failed(batch, task, error)
        if not isinstance(error, InputError):
            _worker_contexts.pop(batch.device, None)  # the device may be in any state: opened anew for the next view
        if isinstance(error, DeviceLostError) and not isinstance(error, _LostAheadError):
            # where it then fails again, this worker has none
            if _lost:
                _lost.clear()
                raise
            _lost.append(task.name)
        return record
    _lost.clear()
    if batch.keep:
        batch.keep((batch.folder, task.key), result, context.device, context.photos)
    about = {"device": context.device.info.title, "worker": worker_name(), "task_seconds": time.perf_counter() - start}
    return writer.submit(_write, batch, task, result, about)


def _find_ahead(batch: Batch, views: dict, following, context: WorkerContext) -> None:
    """Some of what can be found of the task that follows, once its depth map is read."""
    for task, depth in following:
        if task.key in _lost_ahead or not depth.done() or depth.exception():
            continue
        if task.key not in context.before:
            context.before = {task.key: batch.before(views, task.partners, depth.result(), batch.config, context.device,
                                                     context.photos)}
        try:
            context.before[task.key].go_on()
        except DeviceLostError as error:
            _lost_ahead.add(task.key)
            raise _LostAheadError(str(error)) from error


def _write(batch: Batch, task: ViewTask, result, about: dict) -> Record:
    try:
        record = write_finished(batch.folder, task, result, batch.extras, about)
    except OutputError:
        raise
    except Exception as error:
        return _failed(batch, task, error)
    note_down(batch.folder, "ended", task.name)
    return record


def _failed(batch: Batch, task: ViewTask, error: Exception) -> Record:
    note_down(batch.folder, "failed", task.name)
    message = str(error) if isinstance(error, PagasError) else f"{type(error).__name__}: {error}"
    return task.failed(message, isinstance(error, InputError))


def _worker_context(device) -> WorkerContext:
    if device not in _worker_contexts:
        _worker_contexts[device] = WorkerContext(claim_device(device))
    return _worker_contexts[device]


def close_worker_contexts() -> None:
    """Let go of everything that this process keeps between tasks, its devices too."""
    with _one_at_a_time:
        for context in _worker_contexts.values():
            context.photos.clear()
        _worker_contexts.clear()
        _lost.clear()
        _lost_ahead.clear()
        give_back()
    trim()


def worker_name() -> str:
    """Machine and process."""
    return f"{_machine()}-{os.getpid()}"


_machine = cache(socket.gethostname)      # whoever asks the system lets other threads go first


def note_down(folder, what: str, name: str) -> None:
    """A line in this process's journal: what it was at when it was lost can be read there."""
    path = work_folder(folder) / "journal" / f"{worker_name()}.txt"
    with translate_os_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(path, "a", encoding="utf-8") as file:
            file.write(f"{datetime.now().isoformat(timespec='milliseconds')} {what} {on_a_line(name)}\n")


def attempts(folder) -> Counter[str]:
    """How often each view was begun in this run, by the journals of all workers; names as they are written there."""
    lines = [line.split(" ", 2) for path in (work_folder(folder) / "journal").glob("*.txt")
             for line in path.read_text(encoding="utf-8").splitlines()]
    return Counter(line[2] for line in lines if line[1:2] == ["began"] and len(line) == 3)    # some may be cut short


def on_a_line(name: str) -> str:
    """A view's name on one line of any text file, whatever characters it has."""
    return name.encode("unicode_escape").decode()
