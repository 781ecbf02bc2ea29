"""What is sent to a worker, and what comes back: small, frozen, free of arrays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pagas_cl.config import Config
from pagas_cl.scene.partners import Partners
from pagas_cl.scene.view import View


@dataclass(frozen=True)
class ViewTask:
    """One view to refine.

    Attributes
    ----------
    name : str
        The view's name.
    stem : str
        What its files are called, below the folder of the run.
    partners : Partners
        Places in Batch.views.
    depth : object with load() and digest
        The initial depth map.
    key : str
        See identity.task_key.
    """

    name: str
    stem: str
    partners: Partners
    depth: Any
    key: str


@dataclass(frozen=True, eq=False)
class Batch:
    """Neighbouring views that one worker refines one after another, so that it reads the photos they share once.

    Attributes
    ----------
    work : callable(views, partners, depth, config, device, photos, progress) -> DepthResult
        A function at the top of a module; `progress` is None in other processes, and where nobody wants to know.
    views : dict of int to View
        Every view that the tasks need; photos and masks are on disk.
    digests : dict of int to str
        See identity.view_digest.
    tasks : tuple of ViewTask
    config : Config
    folder : Path
        Where results go; every worker sees it under this name.
    device : Device, str, tuple of str, or None
        See runtime.claim.claim_device; a Device is taken as it is (in this process only).
    code : str
        Version of the code that planned it.
    extras : bool
        Whether status, deviation and parallax are kept beside the depth.
    """

    work: Callable
    views: dict[int, View]
    digests: dict[int, str]
    tasks: tuple[ViewTask, ...]
    config: Config
    folder: Path
    device: Any
    code: str
    extras: bool = True

    def only(self, tasks) -> Batch:
        """The same with fewer tasks."""
        needed = {index for task in tasks for index in task.partners.all}
        return replace(self, tasks=tuple(tasks), views={k: v for k, v in self.views.items() if k in needed},
                       digests={k: v for k, v in self.digests.items() if k in needed})


@dataclass(frozen=True)
class Record:
    """What is known of one view when it is done.

    Attributes
    ----------
    name, stem, key : str
        As in ViewTask.
    reason : str
        Why the view was kept as it came; empty where it was refined.
    counts : dict of str to int
        Pixels refined, kept, rejected, without surface.
    report : dict
        DepthResult.report, and the device and worker.
    sizes : dict of str to int
        Bytes of the files that belong to it.
    error : str
        What went wrong, one sentence; empty where the view is done.
    bad_input : bool
        Whether the error lies in the input.
    """

    name: str
    stem: str
    key: str
    reason: str = ""
    counts: dict = field(default_factory=dict)
    report: dict = field(default_factory=dict)
    sizes: dict = field(default_factory=dict)
    error: str = ""
    bad_input: bool = False
