"""Photos, depth and normals of a solid: pixel integrals by 3 x 3 samples, in row blocks so that memory stays small."""

from dataclasses import dataclass

import numpy as np
from support.synthetic.solid import MISS, Solid
from support.synthetic.texture import Texture

_ROWS = 1 << 16  # pixels at a time
_SAMPLES = 3       # along each side of a pixel
_SHININESS = 24.0  # exponent of the highlight
_SUN = np.array([0.35, -0.45, -0.82]) / np.linalg.norm([0.35, -0.45, -0.82])


@dataclass(frozen=True)
class Look:
    """How a surface turns light into colour, and a camera light into a photo: colour * gain + offset + noise."""

    shading: float = 0.3    # share of the light that falls off with the angle to a distant sun; the same in every view
    shine: float = 0.0      # strength of a highlight that moves with the viewer (1 is white)
    gain: float = 1.0
    offset: float = 0.0
    noise: float = 0.0      # standard deviation, share of full scale
    seed: int = 0           # of the noise
    backdrop: Texture | None = None     # where a ray meets nothing, coordinates are pixels; None is black


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


def photograph(solid: Solid, texture: Texture, camera, look: Look = Look()) -> np.ndarray:
    """8-bit photo of the solid, uint8 (height, width, 3)."""
    photo = np.empty((camera.height, camera.width, 3), np.uint8)
    rng = np.random.default_rng(look.seed)
    for rows in _row_blocks(camera):
        light = _light(solid, texture, camera, rows, look) * look.gain + look.offset
        if look.noise > 0:
            light += look.noise * rng.standard_normal(light.shape, dtype=np.float32)
        photo[rows] = np.rint(np.clip(light, 0, 1) * 255).astype(np.uint8).reshape(photo[rows].shape)
    return photo


def _light(solid, texture, camera, rows, look):
    """Mean colour of the samples of each pixel of a row block: float32 (pixels, 3)."""
    # one row more on each side, so that a block knows the parts of all neighbours
    low, high = max(rows.start - 1, 0), min(rows.stop + 1, camera.height)
    depth, part = _centres(solid, camera, slice(low, high), False)
    depth, part, mixed = (values[rows.start - low:rows.stop - low].ravel() for values in (depth, part, _edges(part)))
    middle = _directions(camera, rows, 0.5, 0.5)
    normal = solid.normals(camera.center + np.where(part == MISS, 1.0, depth)[:, None] * middle, part, precise=False)
    unmixed = ~mixed & (part != MISS)
    total = np.zeros((len(depth), 3), np.float32)
    places = [((i + 0.5) / _SAMPLES, (j + 0.5) / _SAMPLES) for j in range(_SAMPLES) for i in range(_SAMPLES)]
    rays = [_directions(camera, rows, *place) for place in places]
    met = solid.meet(camera.center, np.concatenate([ray[mixed] for ray in rays]), precise=False)
    for (du, dv), ray, *met_here in zip(places, rays, *(np.split(found, len(places)) for found in met)):
        here, of = depth.copy(), part.copy()
        here[mixed], of[mixed] = met_here
        # tangent plane at the pixel's centre, then one Newton step on the relief
        with np.errstate(divide="ignore", invalid="ignore"):
            here[unmixed] *= ((normal * middle).sum(1) / (normal * ray).sum(1))[unmixed]
        hit, miss = np.flatnonzero(of != MISS), np.flatnonzero(of == MISS)
        colour = np.zeros((len(depth), 3), np.float32)
        colour[hit] = _colour(solid, texture, camera, ray[hit], here[hit], of[hit], look)
        if look.backdrop is not None and len(miss):
            row, column = np.divmod(miss + rows.start * camera.width, camera.width)
            colour[miss] = look.backdrop(column + du - camera.width / 2, row + dv - camera.height / 2)
        total += colour
    return total / _SAMPLES**2


def _colour(solid, texture, camera, ray, depth, part, look):
    """Colour of the points that the rays meet: float32 of shape (n, 3)."""
    point = camera.center + depth[:, None] * ray
    height, slope_x, slope_y = solid.height(point[:, 0], point[:, 1], precise=False)
    rise, smooth = solid.rises(part)
    gap = point[:, 2] - height
    fall = np.maximum(ray[:, 2] - slope_x * ray[:, 0] - slope_y * ray[:, 1], 0.05)
    point -= np.where(smooth, (gap + rise) / fall, 0.0)[:, None] * ray
    # walls and the bar have no area in (x, y): shift the texture along with their height above the relief
    lift = np.where(smooth, -rise, gap)
    light = texture(point[:, 0] + 0.8 * lift, point[:, 1] + 0.6 * lift)
    if look.shading or look.shine:
        normal = solid.normals(point, part, slopes=(slope_x, slope_y))
        light = light * (1 - look.shading + look.shading * np.maximum(normal @ _SUN, 0))[:, None].astype(np.float32)
    if look.shine:  # Blinn's highlight
        toward = camera.center - point
        half = toward / np.linalg.norm(toward, axis=1, keepdims=True) + _SUN
        half /= np.linalg.norm(half, axis=1, keepdims=True)
        highlight = look.shine * np.maximum((normal * half).sum(1), 0) ** _SHININESS
        light = light + highlight[:, None].astype(np.float32)
    return light


def _centres(solid, camera, rows, precise):
    """Depth and part at the pixel centres, of shape (rows, width)."""
    found = solid.meet(camera.center, _directions(camera, rows, 0.5, 0.5), precise=precise)
    return tuple(values.reshape(-1, camera.width) for values in found)


def _directions(camera, rows, du, dv):
    """World directions (camera z = 1) through (column + du, row + dv), float64 of shape (pixels, 3)."""
    x = (np.arange(camera.width) + du - camera.cx) / camera.fx
    y = (np.arange(rows.start, rows.stop) + dv - camera.cy) / camera.fy
    x, y = np.meshgrid(x, y)
    return np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=-1) @ camera.world_to_camera[:3, :3]


def _edges(part):
    """Pixels whose eight neighbours do not all lie on the same part."""
    padded = np.pad(part, 1, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, (3, 3))
    return (windows != part[..., None, None]).any(axis=(2, 3))


def _row_blocks(camera):
    step = max(1, _ROWS // camera.width)
    for start in range(0, camera.height, step):
        yield slice(start, min(start + step, camera.height))
