"""Hard cases of size: 12 megapixels, and more than 2^24. The twin runs on a window cut out of the far corner."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from support.hard_check import Outcome, difference, repeated_gradient, twin_gradient
from support.hard_scenes import HardScene, base, camera, turn, waves
from support.hard_table import BLENDS, Case

from pagas_cl.scene.view import View

WINDOW, BORDER = 128, 40       # pixels: of the window in the far corner, and of its border that is not compared
TOLERANCE, MOST_PIXELS = 2e-2, 5e-3      # of all pixels together, and of 99 of 100 of them one by one
WHY = ("a position of 4000 pixels is rounded to 2e-4: a few pixels in a thousand decide otherwise at a threshold or "
       "the sign of a residual, and carry most of the difference")
SHIFT = 0.004                  # baseline: so short that the window sees all that reaches it
SIZES = {"12 megapixels": (4000, 3000), "more than 2^24 pixels": (4128, 4120)}


def make_large(size) -> tuple[HardScene, HardScene]:
    """A large scene of depth about 1, photos and depth repeating small ones, and its far corner's pixels as another."""
    width, height = size
    small, rng = base(7, (256, 256)), np.random.default_rng(9)
    times = height // 256 + 1, width // 256 + 1
    depth = np.tile(waves(rng, (256, 256), 0.97), times)[:height, :width].astype(np.float32)
    tile = lambda v: np.tile(v.image, (*times, 1))[:height, :width]  # noqa: E731
    focal = (1.2 * width, 1.21 * width)
    places = [(SHIFT * np.cos(k), SHIFT * np.sin(k), 0.0) for k in range(2)]
    views = [View(camera(size, focal, name="target"), tile(small.target))]
    views += [View(camera(size, focal, place, turn(), name=f"context {k}"), tile(small.contexts[k]))
              for k, place in enumerate(places)]
    cut = [View(replace(v.camera, width=WINDOW, height=WINDOW, cx=v.camera.cx - (width - WINDOW),
                        cy=v.camera.cy - (height - WINDOW)), v.image[-WINDOW:, -WINDOW:]) for v in views]
    return HardScene(views[0], views[1:], depth), HardScene(cut[0], cut[1:], depth[-WINDOW:, -WINDOW:])


def corner_gradient(corner: HardScene, shape, config) -> np.ndarray:
    """What the twin gives for the corner, with the pixel and window counts of the whole, of `shape`."""
    share, (height, width) = config.loss.ssim, shape
    colour, ssim = (twin_gradient(corner, config.with_settings(loss__ssim=only), corner.depth, corner.depth, 1.0)[0]
                    for only in (0.0, 1.0))
    windows = lambda w, h: (w - 10) * (h - 10) / (w * h)  # noqa: E731
    return (1 - share) * colour + share * ssim * windows(WINDOW, WINDOW) / windows(width, height)


def run_one(name: str, blend: str, device) -> Outcome:
    """One large case: finite, the same bits twice, and the far corner as the twin has it."""
    (whole, corner), case = make_large(SIZES[name]), Case(name, base, TOLERANCE, why=WHY)
    config = BLENDS[blend].with_settings(splatting__depth_slices=1e-3)      # the range of depth differs in the window
    got, length, faults = repeated_gradient(whole, config, device, whole.depth, whole.depth, 1.0)
    inside = (slice(-WINDOW + BORDER, -BORDER),) * 2
    want = corner_gradient(corner, whole.depth.shape, config)
    worst = difference(got[inside], want[inside], length[inside])
    if not worst <= case.tolerance:
        faults.append(f"gradient differs from the twin by {worst:.3g}")
    most = np.quantile(np.abs(got[inside] - want[inside]), 0.99) / np.sqrt(np.mean(want[inside] ** 2))
    if not most <= MOST_PIXELS:
        faults.append(f"one pixel in a hundred differs by more than {most:.3g} of the usual gradient")
    return Outcome(case, blend, worst, tuple(faults))


def run_large(device) -> Iterator[Outcome]:
    """Every large case with each blend, as they come."""
    return (run_one(name, blend, device) for name in SIZES for blend in BLENDS)
