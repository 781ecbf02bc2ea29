"""What is put on or in front of a relief: blocks with upright walls, a round bar."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


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


@dataclass(frozen=True)
class Bar:
    """A round bar without ends: a point of its axis, unit direction, radius; scene units."""

    point: tuple[float, float, float]
    direction: tuple[float, float, float]
    radius: float


def near_block(block: Block, reach, origin, directions) -> np.ndarray:
    """Indices of the rays that may touch the block: those that pass its bounding circle between its two heights."""
    radius = np.hypot(block.half_width, block.half_height)
    low, high = -reach - block.rise, reach
    ends = [origin[:2] + ((z - origin[2]) / directions[:, 2])[:, None] * directions[:, :2] for z in (low, high)]
    span = ends[1] - ends[0]
    length = np.maximum((span**2).sum(1), 1e-30)
    where = np.clip(((np.array([block.x, block.y]) - ends[0]) * span).sum(1) / length, 0, 1)
    nearest = ends[0] + where[:, None] * span
    return np.flatnonzero(np.hypot(nearest[:, 0] - block.x, nearest[:, 1] - block.y) <= radius)


def wall_normals(block: Block, points) -> np.ndarray:
    """Outward unit normals at points (n, 3) on the walls."""
    u, v = block.frame(points[:, :2])
    across = np.abs(np.abs(u) - block.half_width) < np.abs(np.abs(v) - block.half_height)
    u, v = np.where(across, np.sign(u), 0.0), np.where(across, 0.0, np.sign(v))
    c, s = np.cos(block.turn), np.sin(block.turn)
    return np.stack([c * u - s * v, s * u + c * v, np.zeros_like(u)], axis=-1)


def meet_bar(bar: Bar, origin, directions) -> np.ndarray:
    """Ray parameter where the rays enter the bar, inf where they pass it."""
    axis = np.asarray(bar.direction)
    ray = directions - (directions @ axis)[:, None] * axis
    arm = origin - np.asarray(bar.point)
    arm = arm - (arm @ axis) * axis
    a, b, c = (ray**2).sum(1), ray @ arm, arm @ arm - bar.radius**2
    inside = b**2 - a * c
    hit = np.full(len(directions), np.inf)
    ok = (inside > 0) & (a > 0)
    hit[ok] = (-b[ok] - np.sqrt(inside[ok])) / a[ok]
    return hit
