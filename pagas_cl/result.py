"""What the refinement of one view gives back."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from pagas_cl.scene.camera import Camera
from pagas_cl.scene.depthmap import surface_depth
from pagas_cl.scene.status import KEPT, NO_SURFACE, REFINED, REJECTED


@dataclass(frozen=True, eq=False)
class DepthResult:
    """A refined depth map and how far to trust it. Arrays have the shape (H, W) of the target's photo.

    Attributes
    ----------
    camera : Camera
    depth : ndarray, float32
        z-depth in scene units, 0 = no surface.
    status : ndarray, uint8
        NO_SURFACE (0), REFINED (1), KEPT (2: no other view sees it, or it is masked out), REJECTED (3: the photos speak
        against the new depth); in the last two the depth is the input's, bit for bit.
    deviation : ndarray, float32
        Standard deviation of the depth in scene units; infinite where the photos say nothing, 0 without a surface.
    parallax : ndarray, float32
        Change of depth that moves a pixel by one pixel in the context views, scene units; 0 where none sees it.
    reason : str
        Why the whole view was kept as it came; empty where it was refined.
    report : dict
        Plain numbers of the run: contexts, steps, cost before and after, held-out views, device_bytes, seconds.
    """

    camera: Camera
    depth: np.ndarray
    status: np.ndarray
    deviation: np.ndarray
    parallax: np.ndarray
    reason: str = ""
    report: dict = field(default_factory=dict)

    @property
    def counts(self) -> dict[str, int]:
        """Pixels that were refined, kept and rejected, and those without a surface."""
        number = np.bincount(self.status.ravel(), minlength=4)
        return {"refined": int(number[REFINED]), "kept": int(number[KEPT]), "rejected": int(number[REJECTED]),
                "no surface": int(number[NO_SURFACE])}

    @cached_property
    def confidence(self) -> np.ndarray:
        """From 0 (the photos say nothing) to 1, float32: 1 / (1 + (deviation / parallax)^2), so that a deviation of
        one pixel of parallax gives a half."""
        return confidence_of(self.depth, self.deviation, self.parallax)

    @cached_property
    def normals(self) -> np.ndarray:
        """Unit normals in camera coordinates, towards the camera, float32 of shape (H, W, 3); 0 where a neighbour is
        missing. From central differences of the points of the depth map (method section 5)."""
        return normals_of(self.depth, self.camera)

    @classmethod
    def missing(cls, camera: Camera, reason: str) -> DepthResult:
        """No surface anywhere, of a view that could not be refined."""
        nothing = np.zeros((camera.height, camera.width), np.float32)
        return cls(camera, nothing, nothing.astype(np.uint8), nothing, nothing, reason, {"failed": reason})

    @classmethod
    def unrefined(cls, camera: Camera, depth: np.ndarray, reason: str, report: dict | None = None) -> DepthResult:
        """The input as it came, with the reason."""
        depth = surface_depth(np.asarray(depth))
        status = np.where(depth > 0, KEPT, NO_SURFACE).astype(np.uint8)
        deviation = np.where(depth > 0, np.inf, 0).astype(np.float32)
        return cls(camera, depth, status, deviation, np.zeros_like(depth), reason, report or {})


def confidence_of(depth: np.ndarray, deviation: np.ndarray, parallax: np.ndarray) -> np.ndarray:
    """Confidence of a depth map; see DepthResult.confidence."""
    with np.errstate(divide="ignore", invalid="ignore"):
        trust = 1 / (1 + np.square(deviation.astype(np.float64) / parallax))
    return np.where((depth > 0) & (parallax > 0) & np.isfinite(trust), trust, 0).astype(np.float32)


def normals_of(depth: np.ndarray, camera: Camera) -> np.ndarray:
    """Normals of a depth map; see DepthResult.normals."""
    points = camera.rays() * depth.astype(np.float64)[..., None]
    normals = np.zeros(points.shape, np.float32)
    across = np.cross(points[2:, 1:-1] - points[:-2, 1:-1], points[1:-1, 2:] - points[1:-1, :-2])
    valid = depth > 0
    whole = (valid[1:-1, 1:-1] & valid[2:, 1:-1] & valid[:-2, 1:-1] & valid[1:-1, 2:] & valid[1:-1, :-2])
    length = np.linalg.norm(across, axis=-1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        normals[1:-1, 1:-1] = np.where(whole[..., None] & (length > 0), across / length, 0)
    return normals
