"""Whether refined views contradict each other (method section 8, consistency check): measured before they are fused."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pagas_cl.config import Config
from pagas_cl.effects import Decision
from pagas_cl.errors import DeviceError

if TYPE_CHECKING:
    from pagas_cl.runtime.device import Device

THRESHOLD = 0.04         # share of contradicted depths above which they are left out
_WHAT = "share of depths that other views contradict"
_SAMPLED, _ASKED, _EVERY = 6, 5, 4      # views looked at, neighbours of each, every n-th row and column


@dataclass(frozen=True)
class LazyDepth:
    """The depth map of a DepthResult, which may be on disk, when it is asked for."""

    result: object

    def load(self) -> np.ndarray:
        return self.result.depth


def device_for(name) -> Device | None:
    """The device to compare depth maps on: that which `name` means (refine_mesh's `device`), the first of several; None
    where there is none."""
    from pagas_cl.runtime.device import open_device

    if isinstance(name, (list, tuple)):
        name = name[0] if name else None
    try:
        return open_device(None if isinstance(name, str) and name == "all" else name)
    except DeviceError:
        return None


def decide_consistency(cameras, depths, config: Config, device=None) -> tuple[Config, Decision | None]:
    """Settle effects.consistency: fusion.agree_views as it follows, and the decision (None where it is "set").

    Parameters
    ----------
    cameras : list of Camera
    depths : list of (ndarray of shape (H, W), something with load(), or None)
        The depth maps that are to be fused.
    device : Device, optional
        Where they are compared; in NumPy by default.
    """
    choice = config.effects.consistency
    if choice == "set" or (choice == "auto" and config.fusion.agree_views > 0):
        return config, None
    have = [k for k, depth in enumerate(depths) if depth is not None]
    if choice != "auto":
        decision = Decision("consistency", float("nan"), THRESHOLD, choice == "on", f"asked for: {choice}")
    elif len(have) < 3:
        decision = Decision("consistency", float("nan"), THRESHOLD, False, "it takes three views to tell who is wrong")
    else:
        share = contradicted([cameras[k] for k in have], [depths[k] for k in have], config.fusion.agree_pixels, device)
        decision = Decision("consistency", share, THRESHOLD, share > THRESHOLD, _WHAT)
    agree = (config.fusion.agree_views or 1) if decision.on else 0
    config = config.with_settings(fusion__agree_views=agree)
    return replace(config, effects=replace(config.effects, consistency="set")), decision


def contradicted(cameras, depths, pixels: float, device=None) -> float:
    """Share of the depths which a neighbouring view should confirm, and none does.

    Some views are looked at, every fourth row and column, each against its nearest neighbours. A depth that is hidden
    from the others, or outside them, is not counted.
    """
    from pagas_cl.surface.agree import counts

    seen, refused = 0, 0
    for k in np.unique(np.linspace(0, len(cameras) - 1, _SAMPLED).astype(int)):
        depth = _array(depths[k])
        sample = np.zeros_like(depth)
        place = np.s_[_EVERY // 2::_EVERY, _EVERY // 2::_EVERY]
        sample[place] = depth[place]
        others = _neighbours(cameras, k)
        near, maps = [cameras[j] for j in others], [_array(depths[j]) for j in others]
        confirmed, should = counts(cameras[k], sample, near, maps, pixels, device)
        seen += int((should > 0).sum())
        refused += int(((should > 0) & (confirmed == 0)).sum())
    return refused / seen if seen else 0.0


def _neighbours(cameras, k: int) -> list[int]:
    """The views whose centres are nearest."""
    away = [float(np.linalg.norm(camera.center - cameras[k].center)) for camera in cameras]
    return [int(j) for j in np.argsort(away, kind="stable") if j != k][:_ASKED]


def _array(depth) -> np.ndarray:
    return np.asarray(depth.load() if hasattr(depth, "load") else depth)
