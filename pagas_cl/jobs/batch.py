"""Views that go to a worker together."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from pagas_cl.config import Config
from pagas_cl.jobs.results import Results
from pagas_cl.jobs.task import ViewTask
from pagas_cl.scene.view import View


@dataclass(frozen=True, eq=False)
class Batch:
    """Neighbouring views that one worker refines one after another, so that it reads the photos they share once."""

    work: Callable      # of a module: (views, partners, depth, config, device, photos, on_step or None) -> DepthResult
    views: dict[int, View]      # every one that the tasks need; for other processes with photos and masks on disk
    digests: dict[int, str]     # of each: equal ones are the same view
    tasks: tuple[ViewTask, ...]
    config: Config
    results: Results          # where they go
    device: Any = None          # see runtime.claim.claim_device; of a worker in another process
    photos: bool = True         # whether the work looks at photos
    keep: Callable | None = None    # (owner, result, device, photos): has what the next round needs stay there
