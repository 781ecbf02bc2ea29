"""At which smaller sizes depth maps move a mesh first, since it begins far off (method section 10.2)."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from pagas_cl.method.surface.mesh_evidence import REACH
from pagas_cl.scene.depthmap import REFINED

# Constants of section 10.2. Shares of refined depths beyond 3 footprints of the given mesh: castle at half size 0.46
# (beyond 12: 0.06), five made scenes 0.02 to 0.30, DTU at half size 0.01.
_FAR = 0.35                # share from which on smaller sizes come first,
_STILL = 0.05              # and that which must lie beyond 3 footprints of a size for the next smaller one to come, too
_SIZES = (0.5, 0.25, 0.125, 0.0625)
_EVERY = 4                 # rows and columns of which one is looked at


class Start:
    """How far off a mesh begins of what depth maps, of DepthResults, have."""

    def __init__(self, results: Sequence[Any]):
        self._results, self._beyond, self._count = results, np.zeros(len(_SIZES), np.int64), 0

    def noted(self, drawn: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
        """The mesh as each view sees it, passed on."""
        for result, depth in zip(self._results, drawn):
            camera, one = result.camera, slice(_EVERY // 2, None, _EVERY)
            before, after = depth[one, one], result.depth[one, one]
            known = (before > 0) & (after > 0) & (result.status[one, one] == REFINED)
            off = np.abs(after[known] / before[known] - 1) * np.sqrt(camera.fx * camera.fy)
            self._beyond += [np.count_nonzero(off * 2 * size > REACH) for size in _SIZES]     # at the next larger size
            self._count += off.size
            yield depth

    def smaller_sizes(self) -> tuple[float, ...]:
        """The sizes that come first, smallest first; none where the start is near."""
        shares = self._beyond / max(self._count, 1)
        if shares[0] < _FAR:
            return ()
        return tuple(size for size, share in zip(_SIZES, shares) if share > _STILL)[::-1]
