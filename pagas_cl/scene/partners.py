"""Who works with a view: the context views that constrain it, and others that only judge the result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pagas_cl.config import MOST_CONTEXTS, Context
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.choice import ContextChooser
from pagas_cl.scene.sampling import DepthSample, sample_depth

MOST_HELD_OUT = 3  # most views that only judge
SPARE_ONE = 6  # with so many usable views, one is spared for that even where all could be used
_MANY = 64  # with more views than this, planning looks at samples of their depth maps


@dataclass(frozen=True)
class Partners:
    """Places in the list of views.

    `contexts`: most useful first, empty where no view is usable; `held_out`: usable views that take no part; `reason`:
    why there are fewer context views than wanted.
    """

    target: int
    contexts: tuple[int, ...]
    held_out: tuple[int, ...] = ()
    reason: str = ""

    @property
    def all(self) -> tuple[int, ...]:
        """Every view that is needed."""
        return (self.target, *self.contexts, *self.held_out)


def for_planning(depth: np.ndarray | DepthSample | None, views: int) -> np.ndarray | DepthSample | None:
    """What is needed of a depth map (or None) to choose partners among so many views: all of it, or a sample."""
    return depth if depth is None or views <= _MANY or isinstance(depth, DepthSample) else sample_depth(depth)


def shared_out(usable: tuple[int, ...], number: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Of usable views, most useful first: the context views, at most `number`, and the held-out views."""
    used = min(number, len(usable) - 1 if len(usable) >= SPARE_ONE else len(usable))
    return usable[:used], usable[used:number + MOST_HELD_OUT]


class PartnerChooser:
    """Chooses for one target after another; parameters as in ContextChooser."""

    def __init__(self, cameras: Sequence[Camera], depths: Sequence[np.ndarray | DepthSample | None],
                 settings: Context):
        self._number = settings.number
        depths = [for_planning(depth, len(cameras)) for depth in depths]
        more = min(settings.number + MOST_HELD_OUT, MOST_CONTEXTS)
        self._chooser = ContextChooser(cameras, depths, replace(settings, number=more))

    def choose(self, target: int) -> Partners:
        choice = self._chooser.choose(target)
        contexts, held_out = shared_out(choice.indices, self._number)
        return Partners(target, contexts, held_out, choice.reason)
