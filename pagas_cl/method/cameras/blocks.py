"""The blocks of all targets of a refinement of cameras (method section 9)."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

from pagas_cl.method.cameras.adjust import Adjuster, Block, Frame


@dataclass(frozen=True)
class Wanted:
    """What is to be computed of a target: places of it and of its context views, and Adjuster.block's arguments."""

    target: int
    others: tuple[int, ...]
    prior: float
    tolerance: float
    limit: float
    sums: bool = True


def blocks(adjuster: Adjuster, frames: Mapping[int, Frame] | Sequence[Frame],
           wanted: Sequence[Wanted]) -> list[Block | None]:
    """The Block of each target; all depths then make their steps, each as if no other had moved."""
    still = {}
    for one in wanted:
        frame = frames[one.target]
        still[one.target] = replace(frame, depth=adjuster.copied(frame))
    found = [adjuster.block(frames[one.target], [still.get(k, frames[k]) for k in one.others], one.prior, one.tolerance,
                            one.limit, one.sums) for one in wanted]
    for frame in still.values():
        frame.depth.release()
    return found


MakeBlocks: TypeAlias = Callable[[Adjuster, Sequence[Frame], Sequence[Wanted]], list[Block | None]]
"""`blocks`, or what does the same by other processes."""
