"""What stands in a synthetic scene: a relief, blocks raised from it, a bar in front; rays meet it exactly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pagas_cl.synthetic.pieces import Bar, Block, meet_bar, near_block, wall_normals
from pagas_cl.synthetic.waves import Waves, joined

MISS, RELIEF, BAR, BLOCK = 0, 1, 2, 3  # block k has its top at BLOCK + 2 k and its walls at BLOCK + 2 k + 1
_TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False)
class Solid:
    """Relief z = sum of `fields` over (x, y), seen from -z; `outline` (half axes) cuts it to an ellipse.

    `limits`: bounds on |z| and on the slope of the relief where they are known better than by summing the waves;
    tight ones make ray casting fast.
    """

    fields: tuple[Waves, ...]
    blocks: tuple[Block, ...] = ()
    bar: Bar | None = None
    outline: tuple[float, float] | None = None
    limits: tuple[float, float] | None = None

    def height(self, x, y, *, precise=True):
        """Relief without blocks: z, dz/dx, dz/dy, float64 of x's shape."""
        total = [np.zeros(np.shape(x)) for _ in range(3)]
        for field in joined(*self.fields):
            for sum_, part in zip(total, field(x, y, precise=precise)):
                sum_ += part
        return total

    def bounds(self) -> tuple[float, float]:
        """A bound on |z| of the relief and one on its slope: `limits`, or sums over the waves that no point exceeds."""
        if self.limits is not None:
            return self.limits
        reach = slope = 0.0
        for field in joined(*self.fields):
            gain = 1.0 if field.envelope is None else 1.0 + np.abs(field.envelope.amplitude).sum()
            lengths = np.linalg.norm(field.turns, axis=1)
            reach += gain * np.abs(field.amplitude).sum()
            slope += gain * 2 * np.pi * (np.abs(field.amplitude) * lengths).sum()
            if field.envelope is not None:
                steep = 2 * np.pi * (np.abs(field.envelope.amplitude)
                                     * np.linalg.norm(field.envelope.turns, axis=1)).sum()
                slope += steep * np.abs(field.amplitude).sum()
        return reach, slope

    def meet(self, origin, directions, *, precise=True):
        """First surface that each ray meets.

        Parameters
        ----------
        origin : ndarray of shape (3,)
            World, on the -z side.
        directions : ndarray of shape (n, 3)
            World, camera z = 1, so that the ray parameter is the z-depth.
        precise : bool
            See Waves.

        Returns
        -------
        depth : float64 of shape (n,), inf where nothing is met
        part : int32 of shape (n,), MISS, RELIEF, BAR or BLOCK + ...
        """
        origin, directions = np.asarray(origin, np.float64), np.asarray(directions, np.float64)
        depth = self._relief(origin, directions, 0.0, precise)
        part = np.full(len(depth), RELIEF, np.int32)
        if self.outline is not None:
            x, y = (origin[:2] + depth[:, None] * directions[:, :2]).T
            outside = (x / self.outline[0]) ** 2 + (y / self.outline[1]) ** 2 > 1
            depth[outside], part[outside] = np.inf, MISS
        for k, block in enumerate(self.blocks):
            self._block(block, BLOCK + 2 * k, origin, directions, depth, part, precise)
        if self.bar is not None:
            hit = meet_bar(self.bar, origin, directions)
            nearer = hit < depth
            depth[nearer], part[nearer] = hit[nearer], BAR
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
        """Outward unit normals at points of shape (n, 3) on the parts of shape (n,); zero where part is MISS.

        `slopes` (dz/dx, dz/dy of the relief at the points) saves their computation.
        """
        if slopes is None:
            slopes = self.height(points[:, 0], points[:, 1], precise=precise)[1:]
        slope_x, slope_y = slopes
        normal = np.stack([slope_x, slope_y, -np.ones_like(slope_x)], axis=-1)
        for k, block in enumerate(self.blocks):
            wall = part == BLOCK + 2 * k + 1
            if wall.any():
                normal[wall] = wall_normals(block, points[wall])
        if self.bar is not None and (part == BAR).any():
            on = part == BAR
            axis = np.asarray(self.bar.direction)
            arm = points[on] - self.bar.point
            normal[on] = arm - (arm @ axis)[:, None] * axis
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        normal[part == MISS] = 0
        return normal

    # -- the relief ------------------------------------------------------------------------------------------------

    def _relief(self, origin, directions, rise, precise):
        """Ray parameter at the first crossing of z = height - rise."""
        reach, slope = self.bounds()
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
        """Newton's steps on depth[todo], in place; returns the rays that did not settle."""
        for _ in range(25):
            if not len(todo):
                break
            ray = directions[todo]
            miss, fall = self._gap(origin, ray, depth[todo], rise, precise)
            step = miss / np.maximum(fall, 0.05 * ray[:, 2])
            depth[todo] -= step
            todo = todo[np.abs(step) > (_TOLERANCE if precise else 1e-4)]
        return todo

    def _gap(self, origin, ray, depth, rise, precise):
        """z of the point on the ray minus the relief's, and its derivative by the ray parameter."""
        x, y, z = (origin + depth[:, None] * ray).T
        height, slope_x, slope_y = self.height(x, y, precise=precise)
        return z - (height - rise), ray[:, 2] - slope_x * ray[:, 0] - slope_y * ray[:, 1]

    def _walk(self, origin, ray, rise, reach, most):
        depth = (-rise - reach - origin[2]) / ray[:, 2]
        todo = np.arange(len(depth))
        for _ in range(400):
            gap, _ = self._gap(origin, ray[todo], depth[todo], rise, False)
            depth[todo] -= gap / (ray[todo, 2] + most[todo])  # at most as far as the steepest slope allows
            todo = todo[gap < -1e-3]
            if not len(todo):
                break
        return depth

    # -- blocks ----------------------------------------------------------------------------------------------------

    def _block(self, block, number, origin, directions, depth, part, precise):
        near = near_block(block, self.bounds()[0], origin, directions)
        if not len(near):
            return
        rays = directions[near]
        top = self._relief(origin, rays, block.rise, precise)
        u, v = block.frame(origin[:2] + top[:, None] * rays[:, :2])
        top[(np.abs(u) > block.half_width) | (np.abs(v) > block.half_height)] = np.inf
        wall = self._walls(block, origin, rays, precise)
        for hit, name in ((top, number), (wall, number + 1)):
            nearer = hit < depth[near]
            depth[near[nearer]], part[near[nearer]] = hit[nearer], name

    def _walls(self, block, origin, rays, precise):
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
