"""What a synthetic scene consists of: its description, the cameras around it, the solids."""

from dataclasses import dataclass

import numpy as np
from support.synthetic.solid import Bar, Block, Solid, height_of
from support.synthetic.waves import Waves

from pagas_cl.errors import InputError
from pagas_cl.scene.camera import Camera

# steps of the view grid in units of the angle between neighbours (right, down), nearest views first
_GRID = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1), (1, -1), (-1, 1), (2, 0), (-2, 0), (0, 2), (0, -2),
         (2, 1), (-2, -1), (1, -2), (-1, 2))
_HELD_OUT = ((0.6, -0.75), (-1.35, 0.45), (0.4, 1.5), (-0.5, -1.4))
_FOCAL = 2892 / 1554  # focal length over image width: 300 units fill most of the image at 650
_OBJECT = 300.0
_DISTANCE = 650.0
PLANE, ELLIPSE = 0.75, 0.38   # half the plane that views may see, half axes of a foreground: shares of the photo


@dataclass(frozen=True)
class Relief:
    """What a synthetic scene is; equal descriptions give equal scenes, byte for byte."""

    width: int = 388            # of the target's photo, pixels
    height: int = 290
    contexts: int = 10          # views that refine
    held_out: int = 2           # views kept for prediction
    spacing: float = 11.0       # angle between neighbouring views, degrees
    base: float = 9.0           # height of the coarse shape: root mean square, scene units; the object is 300 wide
    detail: float = 0.25        # height of the fine detail: mean absolute depth in pixels of parallax at `spacing`
    finest: float = 5.0         # wavelengths of the detail: from `finest` to `coarsest` pixels of the target,
    coarsest: float = 40.0
    power: float = 2.0          # with amplitudes that grow as wavelength**power
    steps: int = 2              # blocks with upright walls that stand on the relief: depth discontinuities
    bar: float = 0.0            # diameter, pixels, of a thin round bar in front; 0 leaves it out
    foreground: bool = False    # an ellipse in front of clutter that is different in every photo; views get masks
    texture: str = "photos"     # or "noise", "flat"
    contrast: float = 1.0       # how strong the texture's departures from mid grey are
    shading: float = 0.3        # share of the light that varies with the slope, the same in every view
    shine: float = 0.0          # strength of a moving highlight
    exposure: float = 0.0       # spread of per-view gain (and a tenth of it of offset), context views only
    noise: float = 0.0          # of the sensor: standard deviation, grey levels of 255
    coarse_error: float = 0.0   # further smooth error of the initial depth: root mean square, pixels of parallax
    seed: int = 0

    def __post_init__(self):
        for name, low, high in (("width", 16, 1 << 15), ("height", 16, 1 << 15), ("contexts", 1, len(_GRID)),
                                ("held_out", 0, len(_HELD_OUT)), ("spacing", 0.01, 20), ("base", 0, 60),
                                ("detail", 0, 4), ("finest", 2, 1e4), ("coarsest", self.finest, 1e4), ("steps", 0, 4),
                                ("bar", 0, 100), ("coarse_error", 0, 20), ("exposure", 0, 1),
                                ("shading", 0, 1), ("shine", 0, 10), ("noise", 0, 255)):
            value = getattr(self, name)
            if not low <= value <= high:
                raise InputError(f"synthetic scene: {name} is {value!r}, expected {low:g} to {high:g}")

    @property
    def footprint(self) -> float:
        """Size of a target pixel on the object, scene units."""
        return _DISTANCE / (_FOCAL * self.width)

    @property
    def parallax(self) -> float:
        """Depth that moves a point by a pixel in a view `spacing` degrees away, scene units."""
        return self.footprint / np.sin(np.radians(self.spacing))


def make_cameras(relief: Relief) -> list[Camera]:
    """Target, contexts, held-out cameras; all look at the origin, where the relief's middle is."""
    return [camera_at(relief, "target", 0, 0),
            *(camera_at(relief, f"context_{k:02d}", *place) for k, place in enumerate(_GRID[:relief.contexts])),
            *(camera_at(relief, f"held_out_{k}", *place) for k, place in enumerate(_HELD_OUT[:relief.held_out]))]


def camera_at(relief, name, right, down) -> Camera:
    """A camera that looks at the relief's middle, `right` and `down` times the spacing away from the front."""
    around, up = np.radians(relief.spacing) * np.array([right, down])
    c, s, cu, su = np.cos(around), np.sin(around), np.cos(up), np.sin(up)
    away = np.array([s * cu, su, -c * cu])  # from the object to the camera
    z = -away
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = [x, np.cross(z, x), z]
    pose[:3, 3] = -pose[:3, :3] @ (away * _DISTANCE)
    f = _FOCAL * relief.width
    # a principal point off the middle, as real cameras have
    return Camera(relief.width, relief.height, f, f, 0.503 * relief.width, 0.494 * relief.height, pose, name)


def make_solids(relief: Relief, rng) -> tuple[Solid, Solid]:
    """The true solid, and the one whose fine detail is smoothed away."""
    pixel = relief.footprint
    base = Waves.random(rng, 6, 0.4 * _OBJECT, 1.2 * _OBJECT, 1.5).scaled(relief.base)
    strength = Waves.random(rng, 4, 60 * pixel, 200 * pixel, 0).scaled(0.35)
    fine = Waves.random(rng, 28, relief.finest * pixel, relief.coarsest * pixel, relief.power, envelope=strength)
    height = fine(*(side / 1.5 for side in _plane(relief, 401)), precise=False)[0]
    fine = fine.scaled(relief.detail * relief.parallax / np.abs(height).mean())
    error = Waves.random(rng, 6, 100 * pixel, 300 * pixel, 1.0).scaled(relief.coarse_error * relief.parallax)
    blocks, bar = _blocks(relief), _bar(relief)
    outline = half_sizes(relief, ELLIPSE) if relief.foreground else None
    return (Solid((base, fine), _limits((base, fine), relief), blocks, bar, outline),
            Solid((base, error), _limits((base, error), relief), blocks, _nearer(bar, relief), outline))


def _limits(fields, relief):
    """Largest height and slope on a dense sample (four a pixel of small photos), and a margin for what lies between."""
    number = min(601, 4 * max(relief.width, relief.height))
    height, slope_x, slope_y = height_of(fields, *_plane(relief, number), precise=False)
    return 1.15 * float(np.abs(height).max()) + 1e-3, 1.15 * float(np.hypot(slope_x, slope_y).max())


def _plane(relief, number):
    """x and y of a grid of points over the part of the plane that the views may see."""
    return np.meshgrid(*(np.linspace(-half, half, number) for half in half_sizes(relief)))


def half_sizes(relief: Relief, share: float = PLANE) -> tuple[float, float]:
    """Half the part of the plane that the views may see, scene units; with ELLIPSE a foreground object's half axes."""
    return share * relief.width * relief.footprint, share * relief.height * relief.footprint


def _blocks(relief):
    w, h = relief.width * relief.footprint, relief.height * relief.footprint
    places = (Block(-0.24 * w, 0.17 * h, 0.11 * w, 0.13 * h, 14.0, 0.2),
              Block(0.26 * w, -0.2 * h, 0.09 * w, 0.1 * h, 25.0, -0.35),
              Block(0.2 * w, 0.25 * h, 0.05 * w, 0.05 * h, 8.0, 0.7),
              Block(-0.28 * w, -0.28 * h, 0.03 * w, 0.12 * h, 18.0, 0.1))
    return places[:relief.steps]


def _bar(relief):
    if not relief.bar:
        return None
    direction = np.array([0.35, 1.0, 0.12])
    direction /= np.linalg.norm(direction)
    depth = _DISTANCE - 70.0
    radius = 0.5 * relief.bar * relief.footprint * depth / _DISTANCE
    return Bar((0.05 * _OBJECT, 0.0, -70.0), tuple(direction.tolist()), radius)


def _nearer(bar, relief):
    """The bar scaled about the target's centre, so that it covers the same pixels there at a slightly wrong depth."""
    if bar is None:
        return None
    factor = 1 - relief.detail * relief.parallax / _DISTANCE
    centre = np.array([0.0, 0.0, -_DISTANCE])
    return Bar(tuple((centre + factor * (np.array(bar.point) - centre)).tolist()), bar.direction, bar.radius * factor)
