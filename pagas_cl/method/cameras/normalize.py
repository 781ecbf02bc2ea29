"""Launches of normalize.cl: photos as they are aligned by, and smoothing (method section 9)."""

import numpy as np
import pyopencl as cl

from pagas_cl.method.splat.constants import define
from pagas_cl.runtime.device import Device
from pagas_cl.runtime.memory import constant
from pagas_cl.runtime.program import build
from pagas_cl.scene.camera import Size

WINDOW = 4                # pixels to each side over which mean and deviation are taken
SOFTENING = 4.0           # grey levels added to the deviation: what is weaker than that is no texture
DEFINES = define(WINDOW=WINDOW, SOFTENING=SOFTENING)


def normalize_photo(device: Device, photo: cl.Buffer, size: Size, sigma: float, out: cl.Buffer) -> None:
    """Fill `out`, float32 (H, W), from a photo of uchar4 (H, W); not a number where it is masked out."""
    program, pair = build(device, "normalize.cl", DEFINES), device.buffer(8 * size.pixels, "pair")
    program.run("luminance", size, photo=photo, pair=pair, **size.extent)
    smooth(device, pair, size, sigma)
    program.run("normalize_photo", size, pair=pair, photo=photo, normal=out, **size.extent)
    pair.release()


def smooth(device: Device, pair: cl.Buffer, size: Size, sigma: float) -> None:
    """Average `pair`, float32 (H, W, 2), by a Gaussian of `sigma` pixels, in place."""
    program, taps = build(device, "normalize.cl", DEFINES), gaussian(sigma)
    between = device.buffer(8 * size.pixels, "pair")
    given = {"taps": constant(device, taps.astype(np.float32)), "radius": len(taps) - 1, **size.extent}
    program.run("smooth_rows", size, pair=pair, out=between, **given)
    program.run("smooth_columns", size, pair=between, out=pair, **given)
    between.release()


def gaussian(sigma: float) -> np.ndarray:
    """Half of a Gaussian's taps, the middle one first; both halves sum to 1."""
    taps: np.ndarray = np.exp(-0.5 * (np.arange(int(np.ceil(3 * sigma)) + 1) / sigma) ** 2)
    return taps / (2 * taps.sum() - taps[0])
