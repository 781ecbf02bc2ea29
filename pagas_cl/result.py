"""What the refinement of one view gives back."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from pagas_cl.scene.camera import Camera
from pagas_cl.scene.depthmap import KEPT, NO_SURFACE, REFINED, REJECTED, central_normals, confidence_of, surface_depth
from pagas_cl.scene.sampling import scene_scale_of

_ROWS = 64      # of a depth map whose normals are worked out in float64 at a time


def in_short(result: Any) -> str:
    """A result in a line: view, size, what became of its depths."""
    counts = ", ".join(f"{number:,} {what}" for what, number in result.counts.items() if number)
    came = f"; unchanged: {result.reason}" if result.reason else ""
    camera = result.camera
    return f"{type(result).__name__}({result.name!r}, {camera.width} x {camera.height}: {counts or 'nothing'}{came})"


@dataclass(frozen=True, eq=False, repr=False)
class DepthResult:
    """A refined depth map and how far to trust it. Arrays have the shape (H, W) of the target's photo."""

    camera: Camera
    """Of the view that was refined."""
    depth: npt.NDArray[np.float32]
    """z-depth in scene units, 0 = no surface."""
    status: npt.NDArray[np.uint8]
    """NO_SURFACE (0), REFINED (1: moved, and photos speak for it there or close by), KEPT (2: no other view sees it, it
    is masked out, the photos show nothing around it, or nothing moved it), REJECTED (3: the photos speak against the
    new depth); in the last two the depth is the input's, bit for bit, or what smaller sizes have left, where these came
    first (effects.pyramid)."""
    deviation: npt.NDArray[np.float32]
    """Standard deviation of the depth in scene units; infinite where the photos say nothing, 0 without a surface."""
    parallax: npt.NDArray[np.float32]
    """Change of depth that moves a pixel by one pixel in the context views, scene units; 0 where none sees it."""
    reason: str = ""
    """Why the whole view was kept as `status` says of single depths; empty where it was refined."""
    report: dict[str, Any] = field(default_factory=dict)
    """Plain numbers of the run: contexts, steps, cost before and after, held-out views and their costs before and after
    (1 - correlation; at the first of smaller sizes: smaller_sizes), device_bytes, seconds."""
    name: str = ""
    """The view's name, by which results find their views; the camera's where it is left out."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", self.name or self.camera.name)

    __repr__ = in_short

    @property
    def counts(self) -> dict[str, int]:
        """Pixels that were refined, kept and rejected, and those without a surface."""
        kinds = {"refined": REFINED, "kept": KEPT, "rejected": REJECTED, "no surface": NO_SURFACE}
        return {name: int(np.count_nonzero(self.status == status)) for name, status in kinds.items()}

    @cached_property
    def scene_scale(self) -> float:
        """As scene.sampling.scene_scale_of has it, without a mask."""
        return scene_scale_of(self.depth, None)

    @cached_property
    def confidence(self) -> npt.NDArray[np.float32]:
        """From 0 (the photos say nothing) to 1, float32: 1 / (1 + (deviation / parallax)^2), so that a deviation of
        one pixel of parallax gives a half."""
        return confidence_of(self.depth, self.deviation, self.parallax)

    @cached_property
    def normals(self) -> npt.NDArray[np.float32]:
        """Unit normals in camera coordinates, towards the camera, float32 of shape (H, W, 3); 0 where a neighbour is
        missing. From central differences of the points of the depth map (method section 5)."""
        return normals_of(self.depth, self.camera)

    @classmethod
    def missing(cls, camera: Camera, reason: str, name: str = "") -> "DepthResult":
        """No surface anywhere, of a view that could not be refined."""
        nothing = np.zeros(camera.size.shape, np.float32)
        return cls(camera, nothing, nothing.astype(np.uint8), nothing, nothing, reason, {"failed": reason}, name)

    @classmethod
    def unrefined(cls, camera: Camera, depth: npt.ArrayLike, reason: str, report: dict[str, Any] | None = None,
                  name: str = "") -> "DepthResult":
        """The input, unchanged, with the reason."""
        depth = surface_depth(np.asarray(depth))
        status = np.where(depth > 0, KEPT, NO_SURFACE).astype(np.uint8)
        deviation = np.where(depth > 0, np.inf, 0).astype(np.float32)
        return cls(camera, depth, status, deviation, np.zeros_like(depth), reason, report or {}, name)


@dataclass(frozen=True)
class RoundInput:
    """A DepthResult of the round before, or what reads its arrays; `identity` is what the device knows it by."""

    identity: Any
    result: Any


def normals_of(depth: np.ndarray, camera: Camera) -> npt.NDArray[np.float32]:
    """Normals of a depth map; see DepthResult.normals."""
    normals = np.empty((*depth.shape, 3), np.float32)
    for start in range(0, len(depth), _ROWS):        # some rows at a time, with a neighbour above and below
        top = max(start - 1, 0)
        part = central_normals(depth[top:start + _ROWS + 1], camera, top)
        normals[start:start + _ROWS] = np.nan_to_num(part[start - top:start - top + _ROWS])
    return normals
