"""Many views on many devices, or in a run that can be killed and started again.

A view's refinement is a pure function, so the engine is any `concurrent.futures.Executor`: a pool of processes, MPI's
pool, or Dask's `Client.get_executor()`. What is here: the description of a view's task (`task`), what a worker does
with it (`worker`), where workers are (`pools`), which views go together (`plan`), what is on disk (`work_folder`,
`finished`), and what is sent again, for parts of other work too (`run`)."""

from pagas_cl.jobs.whole import refine_all
from pagas_cl.jobs.worker import follow_parent

__all__ = ["follow_parent", "refine_all"]
