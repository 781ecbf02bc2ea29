"""Twin of splat.clh: which Gaussians reach which pixels of a context view, and with what weight (method section 4).

A *pair* is a Gaussian that may reach a pixel. The paper's blend ("alpha") ends at steps: a Gaussian is within the
radius or not, before the depth threshold or not. The order-free blend has the same bounds and comes to them smoothly,
so that rounding, which moves a Gaussian by a millionth of a pixel, changes its image and gradient by as little. Which
surface is the first one in a pixel stays a step.
"""

from dataclasses import dataclass, replace

import numpy as np

from pagas_cl.config import Splatting
from twins.project import Projected

ALPHA_MAX = 0.999     # "alpha": clamp of a Gaussian's weight
ALPHA_SEEN = 1 / 255  # least weight that says "there is a surface"
NEAREST = 128         # most participants of a pixel in the alpha blend


@dataclass(frozen=True, eq=False)
class Pairs:
    """P pairs of Gaussian and pixel, sorted by (pixel, z, Gaussian).

    `alpha` is what the blend takes of `raw`: clamped at 0.999 ("alpha"), or times the window and the share that the
    depth threshold leaves (order-free).
    """

    gaussian: np.ndarray    # (P,) int64: index of the target pixel
    pixel: np.ndarray       # (P,) int64: of the context pixel, row * width + column
    Delta: np.ndarray       # (P, 2): pixel centre minus projected mean, pixels
    z: np.ndarray           # (P,)
    raw: np.ndarray         # (P,): weight o exp(-1/2 Delta^T K Delta)
    alpha: np.ndarray       # (P,)
    alpha_d: np.ndarray     # (P,): d alpha / dd of the pair's own Gaussian, the share held fixed; 0 where it is clamped
    share: np.ndarray       # (P,): how much of the weight the depth threshold leaves, 0 to 1

    def where(self, keep: np.ndarray) -> "Pairs":
        """The pairs where `keep` holds, order kept."""
        return Pairs(*(getattr(self, name)[keep] for name in self.__dataclass_fields__))

    def shared(self, share: np.ndarray) -> "Pairs":
        """The pairs with a share of their weight above 0, order kept."""
        kept = replace(self, alpha=share * self.alpha, alpha_d=share * self.alpha_d, share=share)
        return kept.where(share > 0)


def candidates(projected: Projected, width: int, height: int, splatting: Splatting) -> Pairs:
    """Pairs that pass the tests valid, z > near and |Delta| <= r (method section 4), with their weights."""
    radius_threshold = splatting.radius
    reach = int(np.floor(radius_threshold + 0.5))
    m = projected.m
    inside = projected.valid & (m > -reach - 1).all(axis=1) & (m < np.array([width, height]) + reach + 1).all(axis=1)
    g = np.flatnonzero(inside)
    steps = np.arange(-reach, reach + 1)[:, None]
    x, y = (np.floor(mean).astype(np.int64) + steps for mean in m[g].T)       # (2 reach + 1, len(g)) each
    (u, in_columns), (v, in_rows) = ((at + 0.5 - mean, (at >= 0) & (at < side))
                                     for at, mean, side in zip((x, y), m[g].T, (width, height)))
    row, column, which = np.nonzero(in_rows[:, None] & in_columns & (np.hypot(u, v[:, None]) <= radius_threshold))
    gaussian, pixel = g[which], y[row, which] * width + x[column, which]
    Delta = np.stack([u[column, which], v[row, which]], axis=-1)
    raw, log_d = _weight(projected, gaussian, Delta)
    if splatting.blend == "alpha":
        alpha, alpha_d = np.minimum(ALPHA_MAX, raw), np.where(raw < ALPHA_MAX, raw * log_d, 0.0)
    else:
        inverse = 1 / max(radius_threshold * radius_threshold, 1e-12)
        t = (Delta**2).sum(axis=1) * inverse
        window = taper(np.sqrt(t))
        window_d = 16 * t**3 * (1 - t**4) * inverse * (Delta * projected.m_d[gaussian]).sum(axis=1)
        alpha, alpha_d = raw * window, raw * (window * log_d + window_d)
    pairs = Pairs(gaussian, pixel, Delta, projected.z[gaussian], raw, alpha, alpha_d, np.ones(len(raw)))
    return pairs.where(np.lexsort((gaussian, pairs.z, pixel)))


def _weight(projected: Projected, g: np.ndarray, Delta: np.ndarray):
    """raw = o exp(-1/2 Delta^T K Delta), and d log(raw)/dd (method section 4)."""
    K, Sigma_d = projected.K[g], projected.Sigma_d[g]
    x, y = Delta.T
    u, v = K[:, 0] * x + K[:, 1] * y, K[:, 1] * x + K[:, 2] * y  # K Delta
    raw = projected.o[g] * np.exp(-0.5 * (u * x + v * y))
    log_d = (u * projected.m_d[g, 0] + v * projected.m_d[g, 1] + projected.log_o_d[g]
             + 0.5 * (u * u * Sigma_d[:, 0] + 2 * u * v * Sigma_d[:, 1] + v * v * Sigma_d[:, 2]))
    return raw, log_d


def taper(x: np.ndarray) -> np.ndarray:
    """(1 - x^8)^2: 1 at x = 0, 0 from x = 1 on, where its slope is 0 too. How a weight comes to a bound."""
    return (1 - np.clip(x, 0, 1) ** 8) ** 2


def nearest_surface(pairs: Pairs, pixels: int) -> np.ndarray:
    """z_first of every pixel: the least z among pairs with raw > 1/255; inf where there is none."""
    z_first = np.full(pixels, np.inf)
    solid = pairs.raw > ALPHA_SEEN
    np.minimum.at(z_first, pairs.pixel[solid], pairs.z[solid])
    return z_first


def shares(pairs: Pairs, pixels: int, splatting: Splatting, depth_threshold: float, z_first=None) -> np.ndarray:
    """How much of each pair's weight takes part, 0 to 1, shape (P,).

    "alpha": all of it up to z_first + depth_threshold, nothing behind; of the 128 nearest alone. Order-free:
    taper((z - z_first) / depth_threshold). `z_first` (pixels,): as it was kept, that of the pairs by default.
    """
    share = np.ones(len(pairs.z))
    if splatting.occlusion:
        z_first = nearest_surface(pairs, pixels) if z_first is None else z_first
        thresholds = np.full(pixels, float(depth_threshold))
        if splatting.depth_relative > 0:
            thresholds = np.minimum(thresholds, splatting.depth_relative * z_first)
        behind = pairs.z - z_first[pairs.pixel]
        if splatting.blend == "alpha":
            share = (pairs.z <= (z_first + thresholds)[pairs.pixel]).astype(float)
        else:
            share = taper(behind / np.maximum(thresholds[pairs.pixel], 1e-20))
    if splatting.blend == "alpha":  # the threshold only cuts a pixel's tail, so that ranks stay
        share *= rank(pairs.pixel) < NEAREST
    return share


def rank(pixel: np.ndarray) -> np.ndarray:
    """Position of each pair in its pixel's list, given the sorted pixel indices."""
    return np.arange(len(pixel)) - np.searchsorted(pixel, pixel, side="left")
