"""Twin of splat/loss: how a rendered view is compared with its photo (method section 5)."""

from functools import cache

import numpy as np

from pagas_cl.config import Loss
from twins.project import Projected

C1, C2 = 0.01**2, 0.03**2                # SSIM's constants for colours in 0..1 (Wang et al. 2004)
WINDOW, WINDOW_SIGMA = 11, 1.5           # pixels: side and standard deviation of SSIM's window (the same)
GRADIENT_LOW, GRADIENT_HIGH = 0.02, 0.1  # paper eq. 6: changes to the next pixel, 0..1, of weight 0 and of weight 1
LUMA = np.array([0.299, 0.587, 0.114])  # Rec. 601


def luma(image: np.ndarray) -> np.ndarray:
    """Grey of shape (H, W) of an image (H, W, 3)."""
    return image @ LUMA


def comparable(image: np.ndarray, loss: Loss) -> np.ndarray:
    """The channels that are compared: (H, W, 3) as it is, or grey of shape (H, W, 1)."""
    return luma(image)[..., None] if loss.grey else image


def w_grad(image: np.ndarray) -> np.ndarray:
    """Texture weight of shape (H, W), 0 to 1 (paper eq. 6): the larger forward difference, averaged over channels.

    A difference that would leave the image is 0.
    """
    across, down = np.zeros_like(image), np.zeros_like(image)
    across[:, :-1] = np.abs(image[:, 1:] - image[:, :-1])
    down[:-1] = np.abs(image[1:] - image[:-1])
    g = np.maximum(across, down).mean(axis=-1)
    return np.clip((g - GRADIENT_LOW) / (GRADIENT_HIGH - GRADIENT_LOW), 0, 1)


def seen(projected: Projected, width: int, height: int) -> np.ndarray:
    """Pixels of a context view, bool (height, width), that a valid target pixel reaches: floor(m) = p, z > near.

    `projected` is under the INITIAL depth of the run (the unseen mask of method section 5).
    """
    m = projected.m[projected.valid]
    m = m[((m >= 0) & (m < (width, height))).all(axis=1)].astype(np.int64)
    mask = np.zeros((height, width), bool)
    mask[m[:, 1], m[:, 0]] = True
    return mask


def pixel_weight(photo: np.ndarray, loss: Loss, seen_mask=None, mask=None) -> np.ndarray:
    """w of shape (H, W): w_grad, unseen mask and foreground mask, as far as they are switched on or given."""
    weight = w_grad(photo) if loss.gradient_weight else np.ones(photo.shape[:2])
    if loss.unseen_mask and seen_mask is not None:
        weight = weight * seen_mask
    return weight if mask is None else weight * mask


def l1(color: np.ndarray, coverage: np.ndarray, photo: np.ndarray, weight: np.ndarray, by_coverage: bool,
       most: float = np.inf, huber: float = 0.0):
    """L1 = mean over all pixels of w A mean_channel min(|C - I|, most) (A only with `by_coverage`).

    With `huber` h above 0, e^2 / (2h) stands for |e| up to h, and |e| - h / 2 beyond.

    Returns the value, dL1/dC of shape (H, W, channels), dL1/dA of shape (H, W).
    """
    residual = color - photo
    weight = weight / weight.size
    size = np.minimum(np.abs(residual), most)
    inner = np.minimum(size, huber)
    if huber > 0:
        size, slope = size - inner + inner**2 / (2 * huber), np.clip(residual / huber, -1, 1)
    else:
        slope = np.sign(residual)
    per_pixel = size.mean(axis=-1)
    w = weight * coverage if by_coverage else weight
    v_color = w[..., None] * slope * (np.abs(residual) <= most) / residual.shape[-1]
    v_coverage = weight * per_pixel if by_coverage else np.zeros_like(weight)
    return float((w * per_pixel).sum()), v_color, v_coverage


@cache
def window() -> tuple[float, ...]:
    """The 1D Gaussian of SSIM, 11 numbers, sum 1; the 2D window is its outer product."""
    x = np.arange(WINDOW) - WINDOW // 2
    g = np.exp(-0.5 * (x / WINDOW_SIGMA) ** 2)
    return tuple(g / g.sum())


def blur(image: np.ndarray) -> np.ndarray:
    """Window means over the windows that lie inside the image: (H, W, ...) to (H - 10, W - 10, ...)."""
    height, width = image.shape[0] - WINDOW + 1, image.shape[1] - WINDOW + 1
    rows = sum(g * image[i:i + height] for i, g in enumerate(window()))
    return sum(g * rows[:, i:i + width] for i, g in enumerate(window()))


def blur_vjp(v_mean: np.ndarray) -> np.ndarray:
    """Backward of blur: (H - 10, W - 10, ...) to (H, W, ...)."""
    height, width = v_mean.shape[:2]
    rows = np.zeros((height, width + WINDOW - 1, *v_mean.shape[2:]))
    for i, g in enumerate(window()):
        rows[:, i:i + width] += g * v_mean
    image = np.zeros((height + WINDOW - 1, *rows.shape[1:]))
    for i, g in enumerate(window()):
        image[i:i + height] += g * rows
    return image


def ssim(x: np.ndarray, y: np.ndarray, robust: float = 0.0, structure: bool = False):
    """Mean SSIM of (H, W, channels) images over channels and windows inside the image, and its gradient by x.

    With `robust` above 0 a window's 1 - SSIM counts as at most that. `structure` leaves out the luminance term.

    Without any such window (a side below 11 pixels) the value is 1, so that 1 - SSIM is 0, and the gradient 0.
    """
    if min(x.shape[:2]) < WINDOW:
        return 1.0, np.zeros_like(x)
    mx, my, xx, yy, xy = np.moveaxis(blur(np.stack([x, y, x * x, y * y, x * y], axis=-1)), -1, 0)
    luminance = 0.0 if structure else 1.0
    a1, a2 = luminance * (2 * mx * my + C1 - 1) + 1, 2 * (xy - mx * my) + C2
    b1, b2 = luminance * (mx**2 + my**2 + C1 - 1) + 1, (xx - mx**2) + (yy - my**2) + C2
    value = a1 * a2 / (b1 * b2)
    v_xy = 2 * a1 / (b1 * b2)
    v_xx = -value / b2
    v_mx = luminance * 2 * (my * a2 / (b1 * b2) - mx * value / b1) - my * v_xy - 2 * mx * v_xx
    if robust > 0:
        kept = value >= 1 - robust
        value, v_mx, v_xx, v_xy = np.maximum(value, 1 - robust), kept * v_mx, kept * v_xx, kept * v_xy
    by_mx, by_xx, by_xy = np.moveaxis(blur_vjp(np.stack([v_mx, v_xx, v_xy], axis=-1)), -1, 0)
    gradient = by_mx + 2 * x * by_xx + y * by_xy
    return float(value.mean()), gradient / value.size


def photometric(color: np.ndarray, coverage: np.ndarray, photo: np.ndarray, loss: Loss, seen_mask=None, mask=None):
    """L_v = (1 - lambda) L1 + lambda (1 - SSIM) of one view, dL_v/dC (H, W, channels) and dL_v/dA (H, W).

    `color` is the rendered C, `photo` alike, channels as of `comparable`; `coverage` is A. The unseen mask (L1 only)
    and the foreground mask (L1; SSIM sees the photo where it is false) are (H, W) bool, or None.
    """
    value, v_color, v_coverage = l1(color, coverage, photo, pixel_weight(photo, loss, seen_mask, mask),
                                    loss.coverage_weight, loss.robust / 4 if loss.robust > 0 else np.inf, loss.huber)
    value, v_color, v_coverage = (1 - loss.ssim) * value, (1 - loss.ssim) * v_color, (1 - loss.ssim) * v_coverage
    if loss.ssim > 0:
        inside = np.ones(photo.shape[:2], bool) if mask is None else np.asarray(mask, bool)
        similarity, v_x = ssim(np.where(inside[..., None], color, photo), photo, loss.robust, loss.structure)
        value += loss.ssim * (1 - similarity)
        v_color = v_color - loss.ssim * np.where(inside[..., None], v_x, 0.0)
    return value, v_color, v_coverage
