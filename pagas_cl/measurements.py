"""What is measured of one view before it is refined, and from where on it calls for an effect (method section 8)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pagas_cl.config import Config

NUMBER, MEAN, QUANTILE, MEAN_SQUARE = range(4)      # as in splat/summary.py
_QUANTISATION = 0.0012   # noise that rounding to 8 bits alone leaves
_MISALIGNED = 0.4        # pixels by which cameras may be off for colours to be compared through them
GLOSSY = 0.009           # residual (0 to 1) that the default weight of the smoothness allows for
_LEAST = 50              # samples from which a share or a median is taken

# effect: (evidence, threshold, whether above it calls for the effect, what is measured)
RULES = {
    "occlusion": ("hidden", 0.002, True, "share of Gaussians hidden by a nearer surface"),
    "unseen_mask": ("unseen", 0.02, True, "share of a context photo that the target does not reach"),
    "exposure": ("exposure_change", 0.012, True, "difference of colour between photos (0 to 1)"),
    "view_dependence": ("residual", 0.035, True, "residual left after exposure (0 to 1)"),
    "antialiasing": ("smallest", 0.36, False, "smallest projected Gaussian, pixels"),
    "smoothness": ("plain", 0.01, True, "share of pixels with little texture"),
    "pyramid": ("far_off", 0.15, True, "share of samples that match two or more pixels away"),
    "noise": ("unexplained", 1.4, True, "noise, residual, cameras that are off; of what the default weight allows for"),
}


@dataclass(frozen=True)
class Measurements:
    """Evidence of one view, from samples of its context views under the initial depth.

    Attributes
    ----------
    overlap : float
        Share of the target's surface that at least one context view sees.
    hidden : float
        Share of the projected Gaussians that a nearer surface hides by more than the depth threshold.
    unseen : float
        Share of a context photo, at least, that the target's surface does not reach.
    exposure_change : float
        Largest median difference of colour between the target's photo and a context photo, 0 to 1.
    gloss : float
        95th percentile of the residual that stays after the exposure fit and after averaging over neighbouring
        samples: what neither texture nor a depth error explains.
    smallest : float
        Smallest median standard deviation of the projected Gaussians over the context views, pixels (0.5 at the
        target's own resolution).
    plain : float
        Share of the target's pixels with little texture.
    noise : float
        Standard deviation of the target's noise, 0 to 1.
    far_off : float
        Share of the textured samples whose patches match clearly better two or more pixels of parallax away.
    misaligned : float
        How far the context photos are off across the direction that depth moves a point in, pixels: root mean square
        over views and quadrants of the target. No depth explains it: cameras, or lenses, are off by about as much.
    masked : bool
        Whether masks were given.
    gains : tuple of tuple
        Gain and offset of each channel for each context view.
    local_gloss : ndarray of shape (down, across), or None
        Residual as in `gloss`, mean over the context views, on a grid of samples over the target; NaN = unknown.
    """

    overlap: float
    hidden: float
    unseen: float
    exposure_change: float
    gloss: float
    smallest: float
    plain: float
    noise: float
    far_off: float
    misaligned: float
    masked: bool
    gains: tuple
    local_gloss: np.ndarray | None = field(default=None, compare=False, repr=False)

    @property
    def unexplained(self) -> float:
        """What the photos show that no depth explains, against what the default smoothness is made for."""
        return max(self.unexplained_everywhere, min(self.residual, 0.1) / GLOSSY)

    @property
    def unexplained_everywhere(self) -> float:
        """The same without gloss, which is in some places more than in others."""
        return max(self.grain, self.misaligned / 0.13)

    @property
    def grain(self) -> float:
        """Noise of the photos, of what the default weight of the smoothness allows for."""
        return self.noise / 0.004

    @property
    def spread(self) -> float:
        """By how much depth errors exceed what the sharpness of the match alone tells (tests/bench/calibration.py)."""
        return max(1.0, self.grain**0.5, self.residual / 0.0125)

    @property
    def residual(self) -> float:
        """gloss; 0 where depth or cameras are too far off for the photos to be compared through them."""
        return 0.0 if self.far_off > RULES["pyramid"][1] or self.misaligned > _MISALIGNED else self.gloss

    @property
    def exposure(self) -> np.ndarray:
        """gains as an array of shape (contexts, 3, 2)."""
        return np.array(self.gains)


def measure(target, contexts, depth, config: Config, device, photos=None, *, entered=None) -> Measurements:
    """Evidence of one view, on the device under the initial depth: a few percent of a refinement.

    Parameters are those of refine_depth; `photos` is a PhotoStore, `entered` the depth where it is on the
    device already (splat.Entered).
    """
    from pagas_cl.splat import probe_view

    found = probe_view(target, contexts, depth, config, device, photos, entered=entered)
    views = found.views
    return Measurements(
        overlap=_number(found.seen[MEAN]), hidden=_share(views["hidden"]), unseen=_unseen(found, contexts),
        exposure_change=_largest([views[f"change {c}"][:, QUANTILE] for c in "rgb"]),
        gloss=float(np.median(np.nan_to_num(views["gloss"][:, QUANTILE]))),
        smallest=_number(np.min(views["size"][:, QUANTILE], initial=np.inf, where=views["size"][:, NUMBER] > 0), 0.5),
        plain=found.plain, noise=max(found.noise, _QUANTISATION),
        far_off=_number(found.far[MEAN]) if found.far[NUMBER] >= _LEAST else 0.0, misaligned=_misaligned(views),
        masked=target.mask is not None or any(view.mask is not None for view in contexts),
        gains=tuple(tuple(tuple(float(v) for v in channel) for channel in gain) for gain in found.gains),
        local_gloss=found.local_gloss)


def _number(value, otherwise: float = 0.0) -> float:
    return float(value) if np.isfinite(value) else otherwise


def _share(rows) -> float:
    """Mean over all samples of all views."""
    return float((np.nan_to_num(rows[:, MEAN]) * rows[:, NUMBER]).sum() / max(1, rows[:, NUMBER].sum()))


def _largest(values) -> float:
    return float(np.nan_to_num(np.abs(values)).max(initial=0.0))


def _unseen(found, contexts) -> float:
    """A sample stands for stride^2 pixels of the target, each of (2 size)^2 pixels in the context photo."""
    size = found.views["size"]
    area = 4 * found.stride**2 * np.nan_to_num(size[:, MEAN_SQUARE]) * size[:, NUMBER]
    pixels = np.array([view.camera.width * view.camera.height for view in contexts])
    return float(np.maximum(0.0, 1 - area / pixels).mean())


def _misaligned(views) -> float:
    aside = np.stack([views[f"aside {k}"] for k in range(4)])
    told = aside[..., QUANTILE][aside[..., NUMBER] >= _LEAST]
    return float(np.sqrt(np.mean(told**2))) if told.size else 0.0
