"""What is measured of one view before it is refined (method section 8); which effects follow: decide.py."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pagas_cl.config import Config
from pagas_cl.method.splat import ViewInput, constants, probe_view
from pagas_cl.method.splat.constants import MEAN, MEAN_SQUARE, NUMBER, QUANTILE

_BY_CAMERAS = 0.2        # of far_off, a squared pixel that photos are off: what a right depth shows then (made scenes)
_QUANTISATION = 0.0012   # noise that rounding to 8 bits alone leaves
_INCOMPARABLE = 2 / 7    # share, as far_off: half of 4/7, which a depth leaves that is wrong everywhere (any of seven
                         # moves may match best, four are far); below, most samples can be compared
_MISALIGNED = 0.4        # pixels by which cameras may be off for colours to be compared through them
_LEAST = 50              # samples from which a share or a median is taken


@dataclass(frozen=True)
class Measurements:
    """Evidence of one view, from samples of its context views under the initial depth; colours are 0 to 1."""

    overlap: float              # share of the target's surface that at least one context view sees
    hidden: float               # share of the Gaussians that a nearer surface hides by more than the depth threshold
    unseen: float               # share of a context photo, at least, that the target's surface does not reach
    exposure_change: float      # largest median difference of colour between the target's photo and a context photo
    specularity: float
    """95th percentile of the residual after exposure fit and local mean: neither texture nor a depth error."""
    smallest: float
    """Smallest median standard deviation of the projected Gaussians, pixels (0.5 at the target's own resolution)."""
    textureless: float          # share of the target's pixels with little texture
    noise: float                # standard deviation of the target's
    far_off: float              # share of textured samples that match clearly better two or more pixels away
    misaligned: float
    """Epipolar residual of context photos, pixels, root mean square: cameras, or lenses, are off by about it."""
    masked: bool                # whether masks were given
    uneven: float = 0.0         # mean where specularity is the 95th percentile: of light everywhere, not of highlights
    mismatched: float = 0.0     # share of a patch's variance that context photos do not explain, median
    local_specularity: np.ndarray | None = field(default=None, compare=False, repr=False)
    """Residual as in `specularity`, mean over the context views, float32 (down, across) on a grid of samples over the
    target; NaN = unknown."""

    @property
    def figures(self) -> dict[str, Any]:
        """All of it by name but for the arrays: Measurements(**figures) decides alike."""
        return {name: value for name, value in vars(self).items() if name != "local_specularity"}

    @property
    def lasting(self) -> bool:
        """Whether it would be about the same under the refined depth: photos were compared and show no specularity."""
        return 0 < self.residual <= constants.SPECULAR_VIEW

    @property
    def unexplained(self) -> float:
        """What the photos show that no depth explains, against what the default smoothness is made for."""
        return max(self.unexplained_everywhere, min(self.residual, 0.1) / constants.SPECULAR_VIEW)

    @property
    def unexplained_everywhere(self) -> float:
        """The same without specularity, which is in some places more than in others."""
        return max(self.relative_noise, self.misaligned / constants.MISALIGNED)

    @property
    def relative_noise(self) -> float:
        """Noise of the photos, of what the default weight of the smoothness allows for."""
        return self.noise / constants.CLEAR_NOISE

    @property
    def error_factor(self) -> float:
        """By how much depth errors exceed what the sharpness of the match alone says (tests/bench/calibration.py)."""
        return max(1.0, self.relative_noise**0.5, self.residual / constants.SURE_SPECULARITY)

    @property
    def residual(self) -> float:
        """specularity; 0 where depth or cameras are too far off for the photos to be compared through them."""
        return 0.0 if self.far_off > _INCOMPARABLE or self.misaligned > _MISALIGNED else self.specularity

    @property
    def shading(self) -> float:
        """uneven, where the photos can be compared."""
        return self.uneven if self.residual > 0 else 0.0

    @property
    def depth_far_off(self) -> float:
        """far_off without what photos that are off show of any depth."""
        return max(0.0, self.far_off - _BY_CAMERAS * self.misaligned**2)


def measure(given: ViewInput, config: Config, scale: float = 1.0) -> Measurements:
    """Evidence of one view under the initial depth, photos at `scale` of their size: a few percent of a refinement."""
    found = probe_view(given, config, scale)
    samples = found.view_samples
    hidden, number = np.nan_to_num(samples["hidden"][:, MEAN]), samples["hidden"][:, NUMBER]
    changes = np.abs([samples[f"change {c}"][:, QUANTILE] for c in "rgb"])
    return Measurements(
        overlap=_number(found.seen[MEAN]), hidden=float((hidden * number).sum() / max(1, number.sum())),
        unseen=_unseen(found, given.contexts),
        exposure_change=float(np.nan_to_num(changes).max(initial=0.0)),
        specularity=float(np.median(np.nan_to_num(samples["specularity"][:, QUANTILE]))),
        uneven=float(np.median(np.nan_to_num(samples["specularity"][:, MEAN]))),
        smallest=_number(np.min(samples["size"][:, QUANTILE], initial=np.inf,
                                where=samples["size"][:, NUMBER] > 0), 0.5),
        textureless=found.textureless, noise=max(found.noise, _QUANTISATION),
        far_off=_number(found.far[MEAN]) if found.far[NUMBER] >= _LEAST else 0.0, misaligned=float(
            np.sqrt(np.mean(_medians(np.concatenate([samples[f"epipolar_offset {k}"] for k in range(4)]))**2))),
        masked=any(view.mask is not None for view in (given.target, *given.contexts)),
        mismatched=float(1 - np.median(_medians(samples["explained"], 1.0))),
        local_specularity=found.local_specularity)


def _number(value, otherwise: float = 0.0) -> float:
    return float(value) if np.isfinite(value) else otherwise


def _unseen(found, contexts) -> float:
    """A sample stands for stride^2 pixels of the target, each of (2 size)^2 pixels in the context photo."""
    size = found.view_samples["size"]
    area = 4 * found.stride**2 * np.nan_to_num(size[:, MEAN_SQUARE]) * size[:, NUMBER]
    pixels = np.array([view.camera.size.pixels for view in contexts])
    return float(np.maximum(0.0, 1 - area / pixels).mean())


def _medians(rows, otherwise: float = 0.0):
    """Of all rows with enough samples; `otherwise` where there are none."""
    found = rows[rows[:, NUMBER] >= _LEAST, QUANTILE]
    return found if found.size else np.array([otherwise])
