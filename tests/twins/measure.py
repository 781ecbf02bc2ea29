"""Twin of splat/measure: how well patches match when the depth, or the photo, is
moved; the specularity of a surface; the noise of a photo; what rows of numbers come to (method section 8)."""

from __future__ import annotations

import numpy as np

from twins.loss import luma
from twins.project import project

HALF, LEAST_PIXELS, NOISE, UNDEFINED = 2, 15, 1.5e-5, 2.0
TEXTURED, OTHER = 1.5, 0.5       # costs above these are of patches without texture, and of other content
WORSE = 0.02                     # a depth that matches worse than another by more is not the right one
SHIFTS = np.array([-4, -2, -1, 0, 1, 2, 4])      # pixels of parallax: the first costs of a sample
NOISE_ROWS = 256                 # rows that are looked at for noise, spread over the photo
BETTER = 0.05                    # by so much a depth far away must match better


def moved_cost(depth, parallax, target, context, shift: float, scene_scale: float,
               epipolar_offset: float = 0.0) -> np.ndarray:
    """1 - correlation of 5x5 patches of the target with the context photo, depths moved by `shift` pixels of parallax
    and the photo by `epipolar_offset` pixels across the direction in which depth moves the middle of a patch in it.

    Parameters
    ----------
    depth, parallax : ndarray of shape (H, W)
        d and u in units.
    target, context : Photo
    shift, scene_scale, epipolar_offset : float
        Pixels of parallax; scene units per device unit; pixels.

    Returns
    -------
    ndarray of shape (H, W); 2 where fewer than 15 pixels of the patch are seen or the target's has no texture
    """
    moved = np.where(depth > 0, depth + shift * parallax, 0.0)
    along = project(depth, target.camera, context.camera, 0.0, scene_scale).m_d
    across = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.maximum(np.linalg.norm(along, axis=1), 1e-15)[:, None]
    landed = project(moved, target.camera, context.camera, 0.0, scene_scale)
    photo, own = luma(context.image), luma(target.image)
    n, sums = 0, np.zeros((5, *depth.shape))
    for pixel in patch(np.arange(depth.size).reshape(depth.shape), fill=-1):      # each pixel of all patches in turn
        value, seen = look_up(photo, landed, context, depth.shape, epipolar_offset * across, pixel.ravel())
        a, b = np.where(seen, value, 0), np.where(seen, own.ravel()[pixel], 0)
        n, sums = n + seen, sums + [a, b, a * a, b * b, a * b]
    mean = sums / np.maximum(n, 1)
    var_w, var_t = mean[2] - mean[0] ** 2, mean[3] - mean[1] ** 2
    deviation = np.sqrt((np.maximum(var_w, 0) + NOISE) * (np.maximum(var_t, 0) + NOISE))
    correlation = (mean[4] - mean[0] * mean[1]) / deviation
    return np.where((n >= LEAST_PIXELS) & (var_t >= 4 * NOISE), 1 - correlation, UNDEFINED)


def sampled(depth, target, context, z_first, depth_threshold: float, scene_scale: float, low_pass: float = 0.0):
    """What a context view shows of each target pixel, arrays of shape (H, W), NaN where it is not seen.

    Parameters
    ----------
    depth : ndarray of shape (H, W)
        Units.
    target, context : Photo
    z_first : ndarray of shape (H', W')
        Nearest depth of each context pixel, inf where there is none.
    depth_threshold, scene_scale, low_pass : float
        Depth threshold in units; scene units per device unit; px^2.

    Returns
    -------
    hidden : 1 behind a nearer surface, else 0
    size : standard deviation of the projected Gaussian, pixels; NaN too where it is hidden
    """
    p = project(depth, target.camera, context.camera, low_pass, scene_scale)
    seen = look_up(luma(context.image), p, context, depth.shape)[1].ravel()
    column, row = np.where(seen[:, None], p.m, 0).astype(int).T
    hidden = p.z > z_first[row, column] + depth_threshold
    size = (p.K[:, 0] * p.K[:, 2] - p.K[:, 1] ** 2) ** -0.25
    return (np.where(seen, hidden, np.nan).reshape(depth.shape),
            np.where(seen & ~hidden, size, np.nan).reshape(depth.shape))


def votes(costs: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """What one view adds to the totals of each sample, shape (2 + shifts, ...): whether it sees it, whether the
    patch has texture, its costs (moves, ...) by shift where it has."""
    shifts = costs[:len(SHIFTS)]
    textured = (shifts < TEXTURED).all(axis=0)
    return np.concatenate([[seen, textured], np.where(textured, shifts, 0.0)])


def like(costs: np.ndarray) -> np.ndarray:
    """1 where the photos may show the same thing; 0 where they show other things, or another depth matches better."""
    shifts = costs[:len(SHIFTS)]
    here = shifts[len(SHIFTS) // 2]
    other = (here > OTHER) | (here > np.minimum(shifts.min(axis=0), UNDEFINED) + WORSE)
    return np.where((here < TEXTURED) & other, 0.0, 1.0)


def explained(costs: np.ndarray) -> np.ndarray:
    """Share of the variance of each sample's patch that the photo explains, NaN where it has no texture."""
    here = costs[len(SHIFTS) // 2]
    return np.where(here < TEXTURED, np.maximum(1 - here, 0) ** 2, np.nan)


def parallax(depth, target, context, scene_scale) -> np.ndarray:
    """Squared pixels that the points of a depth map (H, W), device units, move by in the context photo where depth
    grows by its own size, from central differences."""
    rotation, tau = context.camera.relative_to(target.camera)
    at = []
    for grown in (1 + 1e-5, 1 - 1e-5):
        point = (grown * depth)[..., None] * (target.camera.rays() @ rotation.T) + tau / scene_scale
        at.append(point[..., :2] / point[..., 2:] * (context.camera.fx, context.camera.fy))
    return (((at[0] - at[1]) / 2e-5) ** 2).sum(axis=-1)


def judged(depth, totals, specularity):
    """What all views say of each sample, three arrays of shape (H, W), NaN where nothing is known.

    Parameters
    ----------
    depth : ndarray of shape (H, W)
    totals : ndarray of shape (2 + shifts, H, W)
        Sum of `votes` over the views.
    specularity : ndarray of shape (views, H, W)

    Returns
    -------
    seen : 1 where some view sees the surface, else 0
    far : 1 where the photos match clearly better two or more pixels of parallax away, else 0
    specularity : mean over the views
    """
    costs, textured = totals[2:] / np.maximum(totals[1], 1), totals[1] > 0
    away = np.abs(SHIFTS) >= 2
    far = costs[away].min(axis=0) < costs[~away].min(axis=0) - BETTER
    known = np.isfinite(specularity).sum(axis=0)
    mean = np.nansum(specularity, axis=0) / np.maximum(known, 1)
    return (np.where(depth > 0, totals[0] > 0, np.nan), np.where(textured, far, np.nan),
            np.where(known > 0, mean, np.nan))


def least_at(costs: np.ndarray) -> np.ndarray:
    """Where costs (5, ...) at -2, -1, 0, 1, 2 pixels are least, by a parabola;
    NaN where one is not defined or none matches."""
    best = costs.argmin(axis=0)
    least = costs.min(axis=0)
    middle = np.clip(best, 1, 3)
    before, after = (np.take_along_axis(costs, (middle + k)[None], 0)[0] - least for k in (-1, 1))
    fine = np.where(middle == best, 0.5 * (before - after) / np.maximum(before + after, 1e-12), 0.0)
    return np.where((costs < TEXTURED).all(axis=0) & (least <= OTHER), best - 2 + fine, np.nan)


def specularity(own, other, state, like, gain) -> np.ndarray:
    """What an exposure fit leaves of matched colours, averaged over 5x5 samples; NaN where fewer than 13 are known.

    Parameters
    ----------
    own, other : ndarray of shape (down, across, 3)
    state, like : ndarray of shape (down, across)
        Whether the colours are seen (> 0), and whether the photos show the same thing there.
    gain : ndarray of shape (3, 2)
        Gain and offset of each channel.
    """
    ok = (state > 0) & like
    total = sum(patch(np.where(ok, (other - own * gain[:, 0] - gain[:, 1]).mean(axis=-1), 0.0)))
    number = sum(patch(ok.astype(float)))
    return np.where(number > 12, np.abs(total) / np.maximum(number, 1), np.nan)


def noise_and_texture(image: np.ndarray) -> tuple[float, float]:
    """Standard deviation of the noise, and the share of pixels with little texture.

    Parameters
    ----------
    image : ndarray of shape (H, W, 3), uint8

    Returns
    -------
    noise : float
        In units of the full range. From the second differences of the smoothest quarter of the pixels, taken along
        rows, whose median deviation is sqrt(6) times that of the noise.
    textureless : float
        Share of pixels where the photo changes by less than 0.02 to its right-hand neighbour (paper eq. 6).
    """
    step = max(1, image.shape[0] // NOISE_ROWS)
    grey = image[::step].astype(np.float32).mean(axis=2) / 255
    if grey.shape[1] < 8:
        return 0.0, 1.0
    bend = np.abs(grey[:, :-2] - 2 * grey[:, 1:-1] + grey[:, 2:])
    slope = np.abs(grey[:, 2:] - grey[:, :-2])
    flat = bend[slope <= np.quantile(slope, 0.25)]
    return float(1.4826 * np.median(flat) / np.sqrt(6)), float((np.abs(np.diff(grey, axis=1)) < 0.02).mean())


def summarize(row: np.ndarray, share: float) -> tuple[float, float, float, float]:
    """How many values there are, their mean, the quantile with `share` of them below it, the mean of their squares; NaN
    is left out."""
    there = row[np.isfinite(row)]
    if not there.size:
        return 0, np.nan, np.nan, np.nan
    return there.size, there.mean(), np.quantile(there, share), (there**2).mean()


def look_up(image, landed, context, shape, moved=0.0, pixel=slice(None)):
    """Bilinear values of `image`, (H', W') or (H', W', C), of the context photo where target pixels landed, and where
    all four pixels are inside and valid; arrays of `shape` (H, W).

    `pixel` (N,): whose projection is looked up, -1 for none; by default each pixel's own. `moved`: pixels by which
    the photo is moved, (N, 2) or 0.
    """
    height, width = image.shape[:2]
    u, v = (landed.m[pixel] + moved - 0.5).T
    inside = landed.valid[pixel] & (u >= 0) & (v >= 0) & (u < width - 1) & (v < height - 1)
    if not isinstance(pixel, slice):
        inside &= pixel >= 0
    (g00, g10, g01, g11), a, b, inside = corners(image, context.mask, u, v, inside)
    if image.ndim == 3:
        a, b = a[:, None], b[:, None]
    value = (1 - b) * ((1 - a) * g00 + a * g10) + b * ((1 - a) * g01 + a * g11)
    return value.reshape(*shape, *image.shape[2:]), inside.reshape(shape)


def corners(image, mask, u, v, inside):
    """The four pixels around each place (u, v) of `image`, how far right and down of the first it is, and where it is
    `inside` and all four are valid in `mask` (or None)."""
    height, width = image.shape[:2]
    x, y = np.where(inside, u, 0).astype(int), np.where(inside, v, 0).astype(int)
    places = [(r, c) for r in (y, np.minimum(y + 1, height - 1)) for c in (x, np.minimum(x + 1, width - 1))]
    a, b = np.where(inside, u, 0) - x, np.where(inside, v, 0) - y
    if mask is not None:
        inside = inside & np.all([mask[place] for place in places], axis=0)
    return [image[place] for place in places], a, b, inside


def patch(image: np.ndarray, half: int = HALF, fill=0):
    """The image moved by each pixel of a patch in turn, `fill` beyond its border."""
    padded = np.pad(image, half, constant_values=fill)
    size = 2 * half + 1
    return (padded[y:y + image.shape[0], x:x + image.shape[1]] for y in range(size) for x in range(size))
