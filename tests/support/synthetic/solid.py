"""What stands in a synthetic scene: a relief, blocks raised from it, a bar in front; rays meet it exactly."""

from dataclasses import dataclass

import numpy as np
from support.synthetic.waves import Waves

MISS, RELIEF, BAR, BLOCK = 0, 1, 2, 3  # block k has its top at BLOCK + 2 k and its walls at BLOCK + 2 k + 1
_TOLERANCE = 1e-9


@dataclass(frozen=True)
class Block:
    """A part of the relief raised towards -z, with upright walls. Lengths in scene units, turn in radians."""

    x: float
    y: float
    half_width: float
    half_height: float
    rise: float
    turn: float = 0.0

    def frame(self, xy, vector=False):
        """Coordinates u, v along the block's sides of points (or vectors) of shape (..., 2)."""
        x, y = np.moveaxis(np.asarray(xy, np.float64), -1, 0)
        if not vector:
            x, y = x - self.x, y - self.y
        c, s = np.cos(self.turn), np.sin(self.turn)
        return c * x + s * y, c * y - s * x

    def turned(self, u, v):
        """The vectors (x, y) that are (u, v) along the block's sides."""
        c, s = np.cos(self.turn), np.sin(self.turn)
        return c * u - s * v, s * u + c * v

    def near(self, reach, origin, directions) -> np.ndarray:
        """Indices of the rays that may touch the block: they pass its bounding circle between its two heights."""
        low, high = -reach - self.rise, reach
        ends = [origin[:2] + ((z - origin[2]) / directions[:, 2])[:, None] * directions[:, :2] for z in (low, high)]
        span = ends[1] - ends[0]
        length = np.maximum((span**2).sum(1), 1e-30)
        where = np.clip(((np.array([self.x, self.y]) - ends[0]) * span).sum(1) / length, 0, 1)
        nearest = ends[0] + where[:, None] * span
        radius = np.hypot(self.half_width, self.half_height)
        return np.flatnonzero(np.hypot(nearest[:, 0] - self.x, nearest[:, 1] - self.y) <= radius)

    def wall_normals(self, points) -> np.ndarray:
        """Outward unit normals at points (n, 3) on the walls."""
        u, v = self.frame(points[:, :2])
        across = np.abs(np.abs(u) - self.half_width) < np.abs(np.abs(v) - self.half_height)
        u, v = np.where(across, np.sign(u), 0.0), np.where(across, 0.0, np.sign(v))
        return np.stack([*self.turned(u, v), np.zeros_like(u)], axis=-1)


@dataclass(frozen=True)
class Bar:
    """A round bar without ends: a point of its axis, unit direction, radius; scene units."""

    point: tuple[float, float, float]
    direction: tuple[float, float, float]
    radius: float

    def across(self, vectors) -> np.ndarray:
        """The part of vectors (..., 3) that is square to the axis."""
        axis = np.asarray(self.direction)
        return vectors - (vectors @ axis)[..., None] * axis

    def meet(self, origin, directions) -> np.ndarray:
        """Ray parameter where the rays enter the bar, inf where they pass it."""
        ray, arm = self.across(directions), self.across(origin - np.asarray(self.point))
        a, b, c = (ray**2).sum(1), ray @ arm, arm @ arm - self.radius**2
        inside = b**2 - a * c
        hit = np.full(len(directions), np.inf)
        ok = (inside > 0) & (a > 0)
        hit[ok] = (-b[ok] - np.sqrt(inside[ok])) / a[ok]
        return hit


@dataclass(frozen=True, eq=False)
class Solid:
    """Relief z = sum of `fields` over (x, y), seen from -z; `outline` (half axes) cuts it to an ellipse.

    `limits`: bounds on |z| and on the slope of the relief; tight ones make ray casting fast.
    """

    fields: tuple[Waves, ...]
    limits: tuple[float, float]
    blocks: tuple[Block, ...] = ()
    bar: Bar | None = None
    outline: tuple[float, float] | None = None

    def height(self, x, y, *, precise=True):
        """Relief without blocks: z, dz/dx, dz/dy, float64 of x's shape."""
        return height_of(self.fields, x, y, precise=precise)

    def meet(self, origin, directions, *, precise=True):
        """First surface that rays from `origin` (3,), on the -z side, meet; `precise` as in Waves.

        `directions` (n, 3) have camera z = 1, so that the ray parameter is the z-depth. Depth: float64 of shape (n,),
        inf where nothing is met; part: int32 of shape (n,), MISS, RELIEF, BAR or BLOCK + ...
        """
        origin, directions = np.asarray(origin, np.float64), np.asarray(directions, np.float64)
        depth = self._meet_relief(origin, directions, 0.0, precise)
        part = np.full(len(depth), RELIEF, np.int32)
        if self.outline is not None:
            x, y = (origin[:2] + depth[:, None] * directions[:, :2]).T
            outside = (x / self.outline[0]) ** 2 + (y / self.outline[1]) ** 2 > 1
            depth[outside], part[outside] = np.inf, MISS
        hits = []  # rays, depths, part
        for k, block in enumerate(self.blocks):
            near = block.near(self.limits[0], origin, directions)
            if len(near):
                hits.append((near, self._meet_top(block, origin, directions[near], precise), BLOCK + 2 * k))
                hits.append((near, self._meet_walls(block, origin, directions[near], precise), BLOCK + 2 * k + 1))
        if self.bar is not None:
            hits.append((np.arange(len(depth)), self.bar.meet(origin, directions), BAR))
        for rays, hit, name in hits:
            nearer = hit < depth[rays]
            depth[rays[nearer]], part[rays[nearer]] = hit[nearer], name
        return depth, part

    def rises(self, part):
        """How far each part lies above the relief (float64), and whether it has the relief's shape (bool)."""
        rise, smooth = np.zeros(len(part)), part == RELIEF
        for k, block in enumerate(self.blocks):
            top = part == BLOCK + 2 * k
            rise[top] = block.rise
            smooth |= top
        return rise, smooth

    def normals(self, points, part, *, slopes=None, precise=True):
        """Outward unit normals at points (n, 3) on the parts (n,); zero where part is MISS. `slopes` (dz/dx, dz/dy of
        the relief at the points) saves their computation."""
        if slopes is None:
            slopes = self.height(points[:, 0], points[:, 1], precise=precise)[1:]
        normal = np.stack([*slopes, -np.ones_like(slopes[0])], axis=-1)
        for k, block in enumerate(self.blocks):
            wall = part == BLOCK + 2 * k + 1
            if wall.any():
                normal[wall] = block.wall_normals(points[wall])
        if self.bar is not None:
            normal[part == BAR] = self.bar.across(points[part == BAR] - self.bar.point)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        normal[part == MISS] = 0
        return normal

    def _meet_relief(self, origin, directions, rise, precise):
        """Ray parameter at the first crossing of z = height - rise."""
        reach, slope = self.limits
        lean = np.linalg.norm(directions[:, :2], axis=1)
        depth = (-rise - origin[2]) / directions[:, 2]
        steep = slope * lean >= 0.98 * directions[:, 2]
        if steep.any():  # more than one crossing is possible: walk up from the near side, never past the first one
            depth[steep] = self._walk(origin, directions[steep], rise, reach, slope * lean[steep])
        lost = self._newton(origin, directions, rise, depth, np.arange(len(depth)), precise)
        if len(lost):
            depth[lost] = self._walk(origin, directions[lost], rise, reach, slope * lean[lost])
            self._newton(origin, directions, rise, depth, lost, precise)
        return depth

    def _newton(self, origin, directions, rise, depth, todo, precise):
        """Newton's steps on depth[todo], in place; returns the rays that did not converge."""
        for _ in range(25):
            if not len(todo):
                break
            ray = directions[todo]
            miss, fall = self._gap(origin, ray, depth[todo], rise, precise)
            step = miss / np.maximum(fall, 0.05 * ray[:, 2])
            depth[todo] -= step
            todo = todo[np.abs(step) > (_TOLERANCE if precise else 1e-4)]
        return todo

    def _walk(self, origin, ray, rise, reach, most):
        """Steps from the near side, none farther than the steepest slope allows."""
        depth = (-rise - reach - origin[2]) / ray[:, 2]
        todo = np.arange(len(depth))
        for _ in range(400):
            gap, _ = self._gap(origin, ray[todo], depth[todo], rise, False)
            depth[todo] -= gap / (ray[todo, 2] + most[todo])
            todo = todo[gap < -1e-3]
            if not len(todo):
                break
        return depth

    def _gap(self, origin, ray, depth, rise, precise):
        """z of the point on the ray minus the relief's, and its derivative by the ray parameter."""
        x, y, z = (origin + depth[:, None] * ray).T
        height, slope_x, slope_y = self.height(x, y, precise=precise)
        return z - (height - rise), ray[:, 2] - slope_x * ray[:, 0] - slope_y * ray[:, 1]

    def _meet_top(self, block, origin, rays, precise):
        top = self._meet_relief(origin, rays, block.rise, precise)
        u, v = block.frame(origin[:2] + top[:, None] * rays[:, :2])
        return np.where((np.abs(u) > block.half_width) | (np.abs(v) > block.half_height), np.inf, top)

    def _meet_walls(self, block, origin, rays, precise):
        first = np.full(len(rays), np.inf)
        u0, v0 = block.frame(origin[:2])
        du, dv = block.frame(rays[:, :2], vector=True)
        for start, speed, half, other, other_speed, other_half in (
                (u0, du, block.half_width, v0, dv, block.half_height),
                (v0, dv, block.half_height, u0, du, block.half_width)):
            for side in (-half, half):
                with np.errstate(divide="ignore", invalid="ignore"):
                    hit = (side - start) / speed
                    along = np.abs(other + hit * other_speed) <= other_half
                ok = np.flatnonzero(np.isfinite(hit) & (hit > 0) & along & (hit < first))
                point = origin + hit[ok, None] * rays[ok]
                height = self.height(point[:, 0], point[:, 1], precise=precise)[0]
                ok = ok[(point[:, 2] <= height) & (point[:, 2] >= height - block.rise)]
                first[ok] = hit[ok]
        return first


def height_of(fields, x, y, *, precise=True):
    """Sum of fields that are not flat: z, dz/dx, dz/dy, float64 of shape (3, *x.shape)."""
    total = np.zeros((3, *np.shape(x)))
    for field in fields:
        if field.amplitude.any():
            total += field(x, y, precise=precise)
    return total
