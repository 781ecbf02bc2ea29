"""What is measured of one view before it is refined, and from where on it calls for an effect (method section 8)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pagas_cl.config import Config
from pagas_cl.scene import exposure as exposures
from pagas_cl.scene.texture import noise_and_texture

_TEXTURED = 1.5          # costs above this are of patches without texture: nothing is read from them
_OTHER = 0.5             # costs above this are of patches that show something else
_QUANTISATION = 0.0012   # noise that rounding to 8 bits alone leaves

# effect: (evidence, threshold, whether above it calls for the effect, what is measured)
RULES = {
    "occlusion": ("hidden", 0.002, True, "share of Gaussians hidden by a nearer surface"),
    "unseen_mask": ("unseen", 0.02, True, "share of a context photo that the target does not reach"),
    "exposure": ("exposure_change", 0.012, True, "difference of colour between photos (0 to 1)"),
    "view_dependence": ("residual", 0.035, True, "residual left after exposure (0 to 1)"),
    "antialiasing": ("smallest", 0.36, False, "smallest projected Gaussian, pixels"),
    "smoothness": ("plain", 0.01, True, "share of pixels with little texture"),
    "noise": ("unexplained", 1.4, True, "noise and residual, of what the default weight allows for"),
    "pyramid": ("far_off", 0.15, True, "share of samples that match two or more pixels away"),
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
    masked : bool
        Whether masks were given.
    gains : tuple of tuple
        Gain and offset of each channel for each context view.
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
    masked: bool
    gains: tuple

    @property
    def unexplained(self) -> float:
        """What the photos show that no depth explains, against what the default smoothness is made for."""
        glossy = self.residual > RULES["view_dependence"][1]
        return max(self.noise / 0.004, min(self.residual, 0.1) / 0.009 if glossy else 0.0)

    @property
    def spread(self) -> float:
        """By how much depth errors exceed what the sharpness of the match alone tells (tests/bench/calibration.py)."""
        return max(1.0, (self.noise / 0.004) ** 0.5, self.residual / 0.0125)

    @property
    def residual(self) -> float:
        """gloss; 0 where the depth is too far off for the photos to be compared through it."""
        return 0.0 if self.far_off > RULES["pyramid"][1] else self.gloss

    @property
    def exposure(self) -> np.ndarray:
        """gains as an array of shape (contexts, 3, 2)."""
        return np.array(self.gains)


def measure(target, contexts, depth, config: Config, device, photos=None) -> Measurements:
    """Evidence of one view, on the device under the initial depth: a few percent of a refinement.

    Parameters are those of refine_depth; `photos` is a PhotoStore.
    """
    from pagas_cl.splat import probe_view

    samples, shape = probe_view(target, contexts, depth, config, device, photos)
    seen = [s.state == 1 for s in samples]
    fits = [exposures.fit(s.own[ok], s.other[ok]) for s, ok in zip(samples, seen)]
    surface = np.isfinite(depth) & (depth > 0)
    noise, plain = noise_and_texture(target.load_image())
    return Measurements(
        overlap=float(np.any(seen, axis=0).sum() / max(1, _sampled(surface, shape).sum())),
        hidden=_share([(s.state == 2).sum() for s in samples], [(s.state > 0).sum() for s in samples]),
        unseen=_unseen(target, contexts, samples, shape),
        exposure_change=max(_change(s, ok) for s, ok in zip(samples, seen)),
        gloss=float(np.median([_gloss(s, ok, fit, shape) for s, ok, fit in zip(samples, seen, fits)])),
        smallest=min((float(np.median(s.size[ok])) for s, ok in zip(samples, seen) if ok.any()), default=0.5),
        plain=plain, noise=max(noise, _QUANTISATION), far_off=_far_off(samples),
        masked=target.mask is not None or any(view.mask is not None for view in contexts),
        gains=tuple(tuple(tuple(float(v) for v in channel) for channel in fit) for fit in fits))


def _sampled(image: np.ndarray, shape) -> np.ndarray:
    stride, across, down = shape
    rows = np.minimum(np.arange(down) * stride + stride // 2, image.shape[0] - 1)
    columns = np.minimum(np.arange(across) * stride + stride // 2, image.shape[1] - 1)
    return image[np.ix_(rows, columns)]


def _share(part, whole) -> float:
    return float(sum(part) / max(1, sum(whole)))


def _unseen(target, contexts, samples, shape) -> float:
    """A sample stands for stride^2 pixels of the target, each of (2 size)^2 pixels in the context photo."""
    area = [shape[0] ** 2 * float((4 * s.size[s.state == 1] ** 2).sum()) for s in samples]
    return float(np.mean([max(0.0, 1 - a / (v.camera.width * v.camera.height)) for a, v in zip(area, contexts)]))


def _change(s, ok) -> float:
    """Medians: neither a highlight on part of the surface nor a wrong depth moves them."""
    return float(np.abs(np.median(s.other[ok] - s.own[ok], axis=0)).max()) if ok.any() else 0.0


def _gloss(s, ok, fit, shape) -> float:
    """Residual after the fit, averaged over 5x5 samples: texture averages out, a highlight does not.

    Where the patches do not show the same texture, something else stands there, and it is no gloss.
    """
    stride, across, down = shape
    here = s.cost[:, 3]
    ok = ok & ~((here > _OTHER) & (here < _TEXTURED))
    residual = np.where(ok, (s.other - s.own * fit[:, 0] - fit[:, 1]).mean(axis=1), 0).reshape(down, across)
    weight = ok.reshape(down, across).astype(np.float64)
    total, number = _box(residual), _box(weight)
    full = number > 12
    return float(np.quantile(np.abs(total[full] / number[full]), 0.95)) if full.any() else 0.0


def _box(image: np.ndarray, half: int = 2) -> np.ndarray:
    padded = np.pad(image, half)
    rows = sum(padded[k:k + image.shape[0]] for k in range(2 * half + 1))
    return sum(rows[:, k:k + image.shape[1]] for k in range(2 * half + 1))


def _far_off(samples) -> float:
    """Share of the textured samples that match clearly better two or more pixels of parallax away."""
    from pagas_cl.splat import SHIFTS

    cost = np.stack([s.cost for s in samples])
    defined = (cost < _TEXTURED).all(axis=2) & np.stack([s.state == 1 for s in samples])
    number = defined.sum(axis=0)
    mean = np.where(defined[..., None], cost, 0).sum(axis=0) / np.maximum(number, 1)[:, None]
    mean = mean[number > 0]
    if len(mean) < 50:
        return 0.0
    here, far = mean[:, np.abs(SHIFTS) < 2].min(axis=1), mean[:, np.abs(SHIFTS) >= 2].min(axis=1)
    return float((far < here - 0.05).mean())
