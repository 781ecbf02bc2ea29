"""Which views go together, and in what order: neighbours share photos."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

from pagas_cl.jobs.finished import stems
from pagas_cl.jobs.identity import task_key, view_digest
from pagas_cl.jobs.store import DepthFile, Store, digest_file
from pagas_cl.jobs.task import Batch, ViewTask
from pagas_cl.scene.partners import PartnerChooser
from pagas_cl.scene.view import View

_BATCH = 16      # most views in a batch
_SHARES = 8      # batches for each worker, so that a slow one leaves its share to others


def on_disk(views: list[View], store: Store) -> list[View]:
    """The views with photos and masks that live in memory put into `store`."""
    def source(value):
        return store.put(value) if isinstance(value, np.ndarray) else value

    return [View(view.camera, source(view.image), source(view.mask), view.name) for view in views]


def make_tasks(views: list[View], depths: list, samples: list, asked: list[int], config, work) -> tuple[list, dict]:
    """Tasks of the views `asked`, and the digests of every view that takes part.

    Parameters
    ----------
    views : list of View
        Photos and masks on disk.
    depths : list of (object with load() and digest, or None)
    samples : list of (DepthSample or None)
        See scene.sampling.
    """
    chooser = PartnerChooser([view.camera for view in views], samples, config.context)
    chosen = [chooser.choose(index) for index in asked]
    taking_part = sorted({index for partners in chosen for index in partners.all})
    _read_digests(views, depths, taking_part)
    digests, names = {index: view_digest(views[index]) for index in taking_part}, stems(views)
    tasks = [ViewTask(views[p.target].name, names[p.target], p, depths[p.target],
                      task_key(p, digests, depths[p.target].digest, config, work)) for p in chosen]
    return tasks, digests


def _read_digests(views, depths, which) -> None:
    """Hash the files of `which` by several threads: a hash waits for the disk."""
    paths = [getattr(source, "path", source) for k in which for source in (views[k].image, views[k].mask)]
    paths += [depths[k].file for k in which if isinstance(depths[k], DepthFile)]
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(digest_file, [path for path in paths if isinstance(path, Path)]))


def in_batches(tasks: list[ViewTask], views: list[View], digests: dict, workers: int, template: Batch) -> list[Batch]:
    """Batches of neighbours, in the order in which they should be given out.

    The views are put along a curve through the camera centres, which is cut into one stretch a worker; batches are
    given out from the start of each stretch in turn, so that workers of one speed go along stretches of their own.
    """
    order = along_curve([views[task.partners.target].camera.center for task in tasks])
    size = int(np.clip(len(tasks) // (workers * _SHARES), 1, _BATCH))
    stretches = [[part[start:start + size] for start in range(0, len(part), size)]
                 for part in np.array_split(order, max(1, workers))]
    longest = max(map(len, stretches))
    parts = [stretch[k] for k in range(longest) for stretch in stretches if k < len(stretch)]
    return [_batch([tasks[k] for k in part], views, digests, template) for part in parts if len(part)]


def _batch(tasks, views, digests, template: Batch) -> Batch:
    needed = sorted({index for task in tasks for index in task.partners.all})
    return replace(template, tasks=tuple(tasks), views={k: views[k] for k in needed},
                   digests={k: digests[k] for k in needed})


def along_curve(points) -> np.ndarray:
    """Order of points along a Morton curve, which keeps neighbours together: intp of shape (N,)."""
    points = np.asarray(points, np.float64).reshape(-1, 3)
    low, span = points.min(axis=0), max(float(np.ptp(points, axis=0).max()), 1e-300)
    cell = ((points - low) / span * 1023).astype(np.int64)
    key = np.zeros(len(points), np.int64)
    for bit in range(10):
        for axis in range(3):
            key |= ((cell[:, axis] >> bit) & 1) << (3 * bit + axis)
    return np.argsort(key, kind="stable")
