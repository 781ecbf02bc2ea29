"""Which pairs of photos cameras are refined by, and which take no part and judge."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pagas_cl.config import Context
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.choice import ContextChoice, ContextChooser, for_planning

MOST = 6                  # context views of a target
FEWEST = 2                # a target with fewer leaves nothing but its free depths
WIDE_AMONG = 32           # views that the widest one is chosen among,
WIDE_OVERLAP = 0.2        # and share of either one's surface that the other sees


@dataclass(frozen=True)
class Pairs:
    """`used`: of each view, its context views; `held`: pairs (one, other) of which neither is a context view of the
    other's; `wide`: further ones of that kind, as wide as views still see the same surface. Held pairs are neighbours:
    a chain of these may bend while each link agrees better."""

    used: tuple[tuple[int, ...], ...]
    held: tuple[tuple[int, int], ...]
    wide: tuple[tuple[int, int], ...] = ()

    def without(self, views: set[int]) -> "Pairs":
        """The pairs without some views; a view that is left with too few constrains nothing."""
        left = [tuple(k for k in others if k not in views) if target not in views else ()
                for target, others in enumerate(self.used)]
        return Pairs(tuple(others if len(others) >= FEWEST else () for others in left),
                     *(tuple(pair for pair in pairs if not views & set(pair)) for pairs in (self.held, self.wide)))


def choose_pairs(cameras: Sequence[Camera], depths: Sequence[np.ndarray], context: Context,
                 hide: bool = True) -> Pairs:
    """Up to MOST context views of each view; a pair of most views is held back. `hide`: depth maps are of one scale, so
    that one shows what another view's surface hides."""
    settings = replace(context, number=min(context.number, MOST) + 1, min_angle=min(context.min_angle, 0.5))
    samples = [for_planning(depth, len(cameras)) for depth in depths]
    usable = [choice.indices for choice in ContextChooser(cameras, samples, settings, hide=hide).all()]
    held: list[tuple[int, int]] = []
    taken: set[int] = set()
    for one, others in enumerate(usable):
        for other in others[1:]:             # not the most useful one
            if (one not in taken and other not in taken and len(others) > FEWEST
                    and len([k for k in usable[other] if k != one]) >= FEWEST):
                held.append((one, other))
                taken |= {one, other}
    apart = {frozenset(pair) for pair in held}
    used = [tuple(k for k in others if frozenset((one, k)) not in apart)[:MOST] for one, others in enumerate(usable)]
    far = replace(settings, number=WIDE_AMONG, min_overlap=max(context.min_overlap, WIDE_OVERLAP))
    wide = _widest(ContextChooser(cameras, samples, far, hide=hide).all(),
                   apart | {frozenset((one, k)) for one, others in enumerate(used) for k in others})
    return Pairs(tuple(used), tuple(held), wide).without(set())


def _widest(choices: Sequence[ContextChoice], near: set[frozenset[int]]) -> tuple[tuple[int, int], ...]:
    """For each view the pair of the widest angle other than those of `near`, of which both see the other."""
    wide: set[tuple[int, int]] = set()
    for one, choice in enumerate(choices):
        usable = [(angle, -other) for other, angle in zip(choice.indices, choice.angles)
                  if frozenset((one, other)) not in near and one in choices[other].indices]
        if usable:
            other = -max(usable)[1]
            wide.add((min(one, other), max(one, other)))
    return tuple(sorted(wide))
