"""Photos, depth and normals of a solid: pixel integrals by 3 x 3 samples, in row blocks so that memory stays small."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pagas_cl.synthetic.solid import MISS, Solid
from pagas_cl.synthetic.texture import Texture

_ROWS = 1 << 16  # pixels at a time
_SUN = np.array([0.35, -0.45, -0.82]) / np.linalg.norm([0.35, -0.45, -0.82])


@dataclass(frozen=True)
class Look:
    """How a surface turns light into colour.

    Attributes
    ----------
    shading : float
        Share of the light that falls off with the angle to a distant sun; the same in every view.
    shine : float
        Strength of a highlight that moves with the viewer (1 is white), and `shininess`, its exponent.
    """

    shading: float = 0.3
    shine: float = 0.0
    shininess: float = 24.0


@dataclass(frozen=True)
class Sensor:
    """What the camera does to light: colour * gain + offset, noise (standard deviation, share of full scale)."""

    gain: float = 1.0
    offset: float = 0.0
    noise: float = 0.0
    seed: int = 0


def depth_and_part(solid: Solid, camera):
    """z-depth at the pixel centres (float64, 0 where nothing is met) and the part met (int32), (height, width)."""
    depth = np.empty((camera.height, camera.width))
    part = np.empty((camera.height, camera.width), np.int32)
    for rows in _row_blocks(camera):
        depth[rows], part[rows] = _centres(solid, camera, rows, True)
    return np.where(part == MISS, 0.0, depth), part


def normals(solid: Solid, camera, depth, part) -> np.ndarray:
    """Unit normals in the camera's frame, towards the camera (float32 of shape (height, width, 3)), 0 where none."""
    out = np.empty((camera.height, camera.width, 3), np.float32)
    turn = camera.world_to_camera[:3, :3]
    for rows in _row_blocks(camera):
        points = camera.center + depth[rows].reshape(-1, 1) * _directions(camera, rows, 0.5, 0.5)
        out[rows] = (solid.normals(points, part[rows].ravel()) @ turn.T).reshape(out[rows].shape)
    return out


def photograph(solid: Solid, texture: Texture, camera, *, look=Look(), sensor=Sensor(), backdrop=None, samples=3):
    """8-bit photo of the solid.

    Parameters
    ----------
    backdrop : Texture or None
        Seen, fixed to the photo (coordinates are pixels), where a ray meets nothing; None is black.
    samples : int
        Samples along each side of a pixel.

    Returns
    -------
    ndarray of uint8, (height, width, 3)
    """
    photo = np.empty((camera.height, camera.width, 3), np.uint8)
    rng = np.random.default_rng(sensor.seed)
    for rows in _row_blocks(camera):
        light = _light(solid, texture, camera, rows, look, backdrop, samples)
        light = light * sensor.gain + sensor.offset
        if sensor.noise > 0:
            light += sensor.noise * rng.standard_normal(light.shape, dtype=np.float32)
        photo[rows] = np.rint(np.clip(light, 0, 1) * 255).astype(np.uint8).reshape(photo[rows].shape)
    return photo


def _light(solid, texture, camera, rows, look, backdrop, samples):
    """Mean colour of the samples of each pixel of a row block: float32 (pixels, 3)."""
    # one row more on each side, so that a block knows the parts of all neighbours
    low, high = max(rows.start - 1, 0), min(rows.stop + 1, camera.height)
    depth, part = _centres(solid, camera, slice(low, high), False)
    mixed = _edges(part)[rows.start - low:rows.stop - low].ravel()
    depth = depth[rows.start - low:rows.stop - low].ravel()
    part = part[rows.start - low:rows.stop - low].ravel()
    middle = _directions(camera, rows, 0.5, 0.5)
    normal = solid.normals(camera.center + np.where(part == MISS, 1.0, depth)[:, None] * middle, part, precise=False)
    total = np.zeros((len(depth), 3), np.float32)
    for j in range(samples):
        for i in range(samples):
            ray = _directions(camera, rows, (i + 0.5) / samples, (j + 0.5) / samples)
            here, of = depth.copy(), part.copy()
            here[mixed], of[mixed] = solid.meet(camera.center, ray[mixed], precise=False)
            unmixed = ~mixed & (part != MISS)
            # tangent plane at the pixel's centre, then one Newton step on the relief
            with np.errstate(divide="ignore", invalid="ignore"):
                here[unmixed] *= ((normal * middle).sum(1) / (normal * ray).sum(1))[unmixed]
            total += _colour(solid, texture, camera, ray, here, of, look, backdrop, rows, (i, j), samples)
    return total / samples**2


def _colour(solid, texture, camera, ray, depth, part, look, backdrop, rows, corner, samples):
    colour = np.zeros((len(depth), 3), np.float32)
    hit = np.flatnonzero(part != MISS)
    point, seen = camera.center + depth[hit, None] * ray[hit], part[hit]
    height, slope_x, slope_y = solid.height(point[:, 0], point[:, 1], precise=False)
    rise, smooth = solid.rises(seen)
    gap = point[:, 2] - height
    fall = np.maximum(ray[hit, 2] - slope_x * ray[hit, 0] - slope_y * ray[hit, 1], 0.05)
    point -= np.where(smooth, (gap + rise) / fall, 0.0)[:, None] * ray[hit]
    # walls and the bar have no area in (x, y): shift the texture along with their height above the relief
    lift = np.where(smooth, -rise, gap)
    light = texture(point[:, 0] + 0.8 * lift, point[:, 1] + 0.6 * lift)
    if look.shading or look.shine:
        normal = solid.normals(point, seen, slopes=(slope_x, slope_y))
        light = light * (1 - look.shading + look.shading * np.maximum(normal @ _SUN, 0))[:, None].astype(np.float32)
        if look.shine:
            light = light + _highlight(look, normal, camera.center - point)
    colour[hit] = light
    if backdrop is not None and len(hit) < len(depth):
        miss = np.flatnonzero(part == MISS)
        row, column = np.divmod(miss + rows.start * camera.width, camera.width)
        colour[miss] = backdrop(column + (corner[0] + 0.5) / samples - camera.width / 2,
                                row + (corner[1] + 0.5) / samples - camera.height / 2)
    return colour


def _highlight(look, normal, toward):
    """Blinn's highlight, float32 of shape (n, 1)."""
    half = toward / np.linalg.norm(toward, axis=1, keepdims=True) + _SUN
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    return (look.shine * np.maximum((normal * half).sum(1), 0) ** look.shininess)[:, None].astype(np.float32)


def _centres(solid, camera, rows, precise):
    ray = _directions(camera, rows, 0.5, 0.5)
    depth, part = solid.meet(camera.center, ray, precise=precise)
    shape = (-1, camera.width)
    return depth.reshape(shape), part.reshape(shape)


def _directions(camera, rows, du, dv):
    """World directions (camera z = 1) through (column + du, row + dv), float64 of shape (pixels, 3)."""
    x = (np.arange(camera.width) + du - camera.cx) / camera.fx
    y = (np.arange(rows.start, rows.stop) + dv - camera.cy) / camera.fy
    x, y = np.meshgrid(x, y)
    return np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=-1) @ camera.world_to_camera[:3, :3]


def _edges(part):
    """Pixels whose eight neighbours do not all lie on the same part."""
    padded = np.pad(part, 1, mode="edge")
    h, w = part.shape
    differ = np.zeros((h, w), bool)
    for dy in range(3):
        for dx in range(3):
            differ |= padded[dy:dy + h, dx:dx + w] != part
    return differ


def _row_blocks(camera):
    step = max(1, _ROWS // camera.width)
    for start in range(0, camera.height, step):
        yield slice(start, min(start + step, camera.height))
