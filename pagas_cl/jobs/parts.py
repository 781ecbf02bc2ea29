"""Parts of one piece of work, such as the blocks of a system, by any executor; results in the order of the parts."""

from collections.abc import Callable, Sequence
from concurrent.futures import BrokenExecutor, Future
from typing import Any

from pagas_cl.errors import PagasError, log
from pagas_cl.jobs.executors import Workers
from pagas_cl.jobs.run import TRIES
from pagas_cl.jobs.task import code_version
from pagas_cl.jobs.worker import WorkerContext, run_part


def results_of(workers: Workers, work: Callable[[Any, WorkerContext], Any], parts: Sequence[Any]) -> list[Any]:
    """What `work(part, context)` gives of each part. One whose worker or device was lost is asked for again, three
    times at most: its last error is raised then."""
    found: dict[int, Any] = {}
    for left in reversed(range(TRIES)):
        todo, futures, errors = [k for k in range(len(parts)) if k not in found], [], []
        try:
            for k in todo:
                futures.append(_sent(workers, work, parts[k]))
            for k, future in zip(todo, futures):
                try:
                    found[k] = future.result()
                except Exception as error:      # whatever it is, another worker may not meet it
                    errors.append(error)
        except BaseException:
            for future in futures:
                future.cancel()
            raise
        if not errors:
            break
        if not left:
            raise errors[-1] if isinstance(errors[-1], PagasError) else PagasError(f"a worker failed: {errors[-1]!r}")
        log.warning("%d of %d parts of the work are given to workers again: %s", len(errors), len(todo), errors[-1])
        broken = [error for error in errors if isinstance(error, BrokenExecutor)]
        if broken:
            workers.renew(broken[0])
    return [found[k] for k in range(len(parts))]


def _sent(workers: Workers, work, part) -> Future:
    try:
        return workers.executor.submit(run_part, work, part, workers.device, code_version())
    except BrokenExecutor as error:
        future: Future = Future()
        future.set_exception(error)
        return future
