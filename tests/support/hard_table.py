"""The table of hard cases, and the settings that they are run with.

tests/hard_cases/README.md lists them with their figures, and those of settings at their limits, which only tests run.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from support import hard_scenes as make

from pagas_cl.app.device_check import ALPHA, ORDER_FREE
from pagas_cl.config import Config

BLENDS = {"order-free": ORDER_FREE, "alpha": ALPHA}
BOTH = tuple(BLENDS)


@dataclass(frozen=True)
class Case:
    """One named case."""

    name: str
    scene: Callable[[], make.HardScene]
    tolerance: float = 1e-3     # most |device - twin| / |twin| of the gradient: see device_check.difference
    settings: dict = field(default_factory=dict)    # on top of the blend's
    blends: tuple[str, ...] = BOTH
    still: bool = False         # no pixel may move: no view sees parallax
    noise: float = 1e-3         # change of the initial depth where the gradient is compared, share of the median
    why: str = ""               # what makes the tolerance wider than usual


def config_of(case: Case, blend: str) -> Config:
    """The settings of `case` with one of its blends."""
    return BLENDS[blend].with_settings(**case.settings)


NEAR_PLANE = "rounding of the projection grows with 1 / z near the camera's plane"
WHOLE = "weights are summed in steps of 2^-20: where the true gradient is 0, a trace below the solver's damping remains"
LONG_LENS = "a position in pixels carries focal length x 6e-8"
THRESHOLD = "float32 decides otherwise for a few Gaussians that lie on a threshold"


def _corner(shape):
    """True at one pixel."""
    mask = np.zeros(shape, bool)
    mask[shape[0] // 2, shape[1] // 2] = True
    return mask


CAMERAS = [
    Case("base", make.base),
    Case("opacity 1: context camera 20 times nearer", lambda: make.base(centers=((0.02, 0.01, 0.93), (0.12, 0, 0))),
         5e-3, why=NEAR_PLANE),
    Case("weights to 0: context camera 30 times farther",
         lambda: make.base(centers=((3.0, 0.5, -29.0), (0.12, 0, 0)), rotations=[make.turn(y=0.1), make.turn(y=0.1)])),
    Case("thousands of Gaussians in one pixel", make.crowded, 5e-3, why=THRESHOLD),
    Case("one Gaussian over 200 pixels", lambda: make.base(context_focal=(600.0, 610.0)), 5e-3,
         dict(splatting__radius=8.0), why=LONG_LENS),
    Case("on, near and behind the context camera's plane", make.within, 1e-2, why=NEAR_PLANE),
    Case("grazing view", make.grazing, 1e-2, why=THRESHOLD),
    Case("zero baseline", lambda: make.base(centers=((0, 0, 0), (0, 0, 0))), still=True),
    Case("pure rotation", lambda: make.base(centers=((0, 0, 0),), rotations=[make.turn(0.05, -0.08, 0.2)]), still=True),
    Case("cameras that face each other",
         lambda: make.base(centers=((0.05, 0.03, 2.2), (0.12, 0, 0)),
                           rotations=[make.turn(y=np.pi), make.turn(y=0.1)])),
    Case("forward motion",
         lambda: make.base(centers=((0, 0, 0.3), (0, 0, -0.4)), rotations=[make.turn(), make.turn()])),
    Case("context looks away", lambda: make.base(centers=((0.1, 0, 0),), rotations=[make.turn(y=np.pi)]), still=True),
    Case("focal length 10 px", lambda: make.base(focal=(10.0, 10.0)), 5e-3, why=NEAR_PLANE),
    Case("focal length 1e6 px", lambda: make.base(focal=(1e6, 1e6), centers=((1e-5, 0, 0), (0, 1e-5, 0))), 2e-2,
         why=LONG_LENS),
    Case("pixels five times as wide as high", lambda: make.base(focal=(30.0, 150.0)), 1e-2, why=THRESHOLD),
    Case("principal point outside the photo",
         lambda: make.base(principal=(-80.0, 95.0), rotations=[make.turn(), make.turn()]), 2e-3),
    Case("units of 1e-6", lambda: make.moved(1e-6)),
    Case("units of 1e6", lambda: make.moved(1e6)),
    Case("units of 1e-20", lambda: make.moved(1e-20)),
    Case("units of 1e20", lambda: make.moved(1e20)),
    Case("origin off by 1e7", lambda: make.moved(1.0, (1e7, -1e7, 5e6))),
]
DEPTHS = [
    Case("depth 0, negative, NaN, infinite, denormal", lambda: make.sprinkled([0, -1, np.nan, np.inf, -np.inf, 1e-40])),
    Case("depths from 1e-20 to 1e20", lambda: make.sprinkled([1e-20, 1e-8, 1e-2, 30.0, 1e3, 1e8, 1e20]), 5e-3,
         why=NEAR_PLANE),
    Case("equal depths and ties",
         lambda: make.with_depth(make.base(centers=((0.157, 0, 0), (0, 0.103, 0)),
                                           rotations=[make.turn(), make.turn()]),
                                 lambda d, rng: np.ones_like(d)), noise=0.0),
    Case("checkerboard of depths",
         lambda: make.with_depth(make.base(), lambda d, rng: np.where(sum(np.indices(d.shape)) % 2, 1.5 * d, d))),
    Case("one valid pixel", lambda: make.with_depth(make.base(), lambda d, rng: np.where(_corner(d.shape), d, 0)), 0.2,
         why=WHOLE),
    Case("no valid pixel", lambda: make.with_depth(make.base(), lambda d, rng: 0 * d), still=True),
]
IMAGES = [
    Case("constant photos", lambda: make.with_photos(lambda rng, shape: np.full(shape, 0.5)), 1e-2, why=WHOLE),
    Case("black photos", lambda: make.with_photos(lambda rng, shape: np.zeros(shape))),
    Case("saturated photos", lambda: make.with_photos(lambda rng, shape: np.ones(shape))),
    Case("one bright pixel", lambda: make.with_photos(lambda rng, shape: 1.0 * _corner(shape)), 2e-3),
    Case("no texture, noise", lambda: make.with_photos(lambda rng, shape: 0.5 + 0.01 * rng.standard_normal(shape)),
         2e-3),
    *(Case(f"{w} x {h} pixels", lambda w=w, h=h: make.base(size=(w, h)))
      for w, h in ((1, 1), (1, 23), (29, 1), (2, 2), (7, 5), (10, 31), (11, 11), (13, 37), (53, 17), (97, 51))),
    Case("photos of 1 x 1", lambda: make.base(context_size=(1, 1))),
    Case("empty target mask", lambda: make.with_masks(target=lambda s: np.zeros(s, bool)), still=True),
    Case("target mask of one pixel", lambda: make.with_masks(target=_corner), 0.2, why=WHOLE),
    Case("empty context masks", lambda: make.with_masks(context=lambda s: np.zeros(s, bool))),
    Case("context masks of one pixel", lambda: make.with_masks(context=_corner)),
]
CASES = [*CAMERAS, *DEPTHS, *IMAGES]
