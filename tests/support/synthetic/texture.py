"""Pictures to wrap around synthetic scenes: photographs that come with scikit-image's wheel, or noise without it."""

from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from PIL import Image

from pagas_cl.errors import InputError, log

PHOTOGRAPHS = ("astronaut.png", "brick.png", "chelsea.png", "coffee.png", "coins.png", "grass.png", "gravel.png",
               "ihc.png", "rocket.jpg", "motorcycle_left.png", "camera.png")


@dataclass(frozen=True, eq=False)
class Texture:
    """Colours on the plane (x, y); texel (row, column) is centred at ((column + 0.5) * size, (row + 0.5) * size) from
    the corner."""

    texels: np.ndarray      # (h, w, 3) float32, 0 to 1
    size: float             # edge of a texel, scene units

    def __call__(self, x, y) -> np.ndarray:
        """Colours (float32 of shape (n, 3)) at points, bilinear, mirrored beyond the edges; (0, 0) is the middle."""
        h, w = self.texels.shape[:2]
        column, right, part_x = _bracket(np.asarray(x) / self.size + w / 2 - 0.5, w)
        row, below, part_y = _bracket(np.asarray(y) / self.size + h / 2 - 0.5, h)
        flat = self.texels.reshape(-1, 3)
        upper = flat[row * w + column] * (1 - part_x) + flat[row * w + right] * part_x
        lower = flat[below * w + column] * (1 - part_x) + flat[below * w + right] * part_x
        return upper * (1 - part_y) + lower * part_y


def _bracket(position, number):
    low = np.floor(position)
    part = (position - low).astype(np.float32)[:, None]
    low = low.astype(np.int64)
    return _mirror(low, number), _mirror(low + 1, number), part


def _mirror(index, number):
    index = np.mod(index, 2 * number)
    return np.where(index < number, index, 2 * number - 1 - index)


def patchwork(width, height, size, rng, *, kind="photos", contrast=1.0, tile=None) -> Texture:
    """A texture of about `width` x `height` texels: `kind` "photos" (tiles cut from photographs), "noise" (smooth, of
    many scales) or "flat" (one grey). Departures from mid grey are multiplied by `contrast`; `tile` is a tile's edge,
    texels: a third of the width by default, at most 300."""
    if kind not in ("photos", "noise", "flat"):
        raise InputError(f"texture is {kind!r}, expected 'photos', 'noise' or 'flat'")
    tile = tile or int(np.clip(width // 3, 48, 300))
    if kind == "photos" and find_spec("skimage") is None:
        log.warning("scikit-image is not installed: the synthetic scene is covered with noise instead of photographs; "
                     'pip install "pagas-cl[report]"')
        kind = "noise"
    if kind == "flat":
        texels = np.full((tile, tile, 3), 0.5, np.float32)
    else:
        texels = noise(width, height, rng) if kind == "noise" else _tiles(width, height, tile, rng)
    return Texture((0.5 + contrast * (texels - 0.5)).astype(np.float32), float(size))


def noise(width, height, rng) -> np.ndarray:
    """Smooth colour noise with detail from 2 texels to a quarter of the width: float32 (height, width, 3) in 0..1."""
    total = np.zeros((height, width, 3), np.float32)
    period, weight = 2, 1.0
    while period <= max(2, min(width, height) // 4):
        coarse = rng.standard_normal((height // period + 3, width // period + 3, 3)).astype(np.float32)
        layer = Texture(coarse, period)
        y, x = np.mgrid[0:height, 0:width]
        total += weight * layer(x.ravel(), y.ravel()).reshape(height, width, 3)
        period, weight = period * 2, weight * 1.15
    total -= total.mean()
    return np.clip(0.5 + 0.2 * total / total.std(), 0.0, 1.0)


def _tiles(width, height, tile, rng):
    folder = Path(find_spec("skimage").origin).parent / "data"
    across, down = -(-width // tile), -(-height // tile)
    texels = np.empty((down * tile, across * tile, 3), np.float32)
    order = []
    for row in range(down):
        for column in range(across):
            order = order or list(rng.permutation(len(PHOTOGRAPHS)))
            with Image.open(folder / PHOTOGRAPHS[order.pop()]) as photo:
                pixels = np.asarray(photo.convert("RGB"), np.float32) / 255.0
            # a square of the photograph; mirrored where the photograph is smaller
            rows, columns = (_mirror(rng.integers(0, max(size - tile, 0) + 1) + np.arange(tile), size)
                             for size in pixels.shape[:2])
            texels[row * tile:(row + 1) * tile, column * tile:(column + 1) * tile] = pixels[rows][:, columns]
    return texels
