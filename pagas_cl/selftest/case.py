"""A hard case as data, and the settings that it is run with."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from pagas_cl.config import Config
from pagas_cl.presets import BALANCED, PAPER
from pagas_cl.selftest.scenes import HardScene

PLAIN = dict(smoothness__kind="none", smoothness__weight=0.0, solver__views_per_step=0, solver__patience=5)
BLENDS = {
    "order-free": BALANCED.with_settings(**PLAIN),
    "alpha": PAPER.with_settings(solver__patience=5),
}
BOTH = tuple(BLENDS)
ONE = ("order-free",)


@dataclass(frozen=True)
class Case:
    """One named case.

    Attributes
    ----------
    name : str
    scene : callable
        Makes the HardScene.
    tolerance : float
        Most |device - twin| / |twin| of the gradient: see check.difference.
    settings : dict
        On top of the blend's.
    blends : tuple of str
    still : bool
        No pixel may move: no view sees parallax.
    noise : float
        By how much the depth differs from the initial one when the gradient is compared, share of the median.
    why : str
        What makes the tolerance wider than usual.
    """

    name: str
    scene: Callable[[], HardScene]
    tolerance: float = 1e-3
    settings: dict = field(default_factory=dict)
    blends: tuple[str, ...] = BOTH
    still: bool = False
    noise: float = 1e-3
    why: str = ""


def config_of(case: Case, blend: str) -> Config:
    """The settings of `case` with one of its blends."""
    return BLENDS[blend].with_settings(**case.settings)
