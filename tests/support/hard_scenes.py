"""Small scenes that are hard for arithmetic: what tests/hard_cases runs on a device.

Each maker returns a HardScene of its own; none reads a file. Lengths are scene units, cameras look along +z.
"""

from dataclasses import dataclass, replace

import numpy as np

from pagas_cl.scene.camera import Camera
from pagas_cl.scene.view import View

SIZE = (40, 32)           # of most scenes: larger than the window of SSIM, quick on any device


@dataclass(frozen=True, eq=False)
class HardScene:
    """What a refinement takes: views, and a depth map (H, W) float64 of the target in scene units, 0 = no surface."""

    target: View
    contexts: list[View]
    depth: np.ndarray

    def mapped(self, change) -> "HardScene":
        """The scene with `change(view)` for each of its views."""
        return replace(self, target=change(self.target), contexts=[change(v) for v in self.contexts])


def turn(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> np.ndarray:
    """Rotation about the camera's axes, radians, x first."""
    (cx, cy, cz), (sx, sy, sz) = np.cos([x, y, z]), np.sin([x, y, z])
    return (np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1.0]]) @ np.array([[cy, 0, sy], [0, 1.0, 0], [-sy, 0, cy]])
            @ np.array([[1.0, 0, 0], [0, cx, -sx], [0, sx, cx]]))


def camera(size, focal, center=(0.0, 0.0, 0.0), rotation=None, principal=None, name="") -> Camera:
    """`focal` is (fx, fy) in pixels; `principal` the middle by default."""
    pose = np.eye(4)
    pose[:3, :3] = np.eye(3) if rotation is None else rotation
    pose[:3, 3] = -pose[:3, :3] @ np.asarray(center, np.float64)
    return Camera(*size, *focal, *(principal or (size[0] / 2 + 0.37, size[1] / 2 - 0.21)), pose, name)


def photo(rng, size) -> np.ndarray:
    """Smooth random texture, uint8 of shape (H, W, 3)."""
    width, height = size
    noise = rng.random((height + 2, width + 2, 3))
    smooth = sum(noise[i:i + height, j:j + width] for i in range(3) for j in range(3)) / 9
    return np.rint(np.clip(0.5 + 1.6 * (smooth - 0.5), 0, 1) * 255).astype(np.uint8)


def waves(rng, size, step: float = 0.85) -> np.ndarray:
    """A wavy slope about 1 deep with a block in front of it at `step` of its depth."""
    v, u = np.mgrid[:size[1], :size[0]] / max(size)
    depth = 1 + 0.12 * u - 0.1 * v + 0.02 * np.sin(9 * u + 5 * v) + 0.003 * rng.standard_normal(u.shape)
    depth[size[1] // 4:size[1] // 2, size[0] // 3:size[0] // 2] *= step
    return depth


def base(seed: int = 1, size=SIZE, focal=None, centers=((0.16, 0.02, -0.03), (-0.11, 0.09, 0.04)), rotations=None,
         context_size=None, context_focal=None, principal=None) -> HardScene:
    """A target and context views around it that look at a wavy slope."""
    rng, f = np.random.default_rng(seed), focal or (1.2 * max(size), 1.25 * max(size))
    rotations = rotations or [turn(y=0.9 * c[0], x=-0.9 * c[1]) for c in centers]
    context_size = context_size or size
    target = View(camera(size, f, principal=principal, name="target"), photo(rng, size))
    contexts = [View(camera(context_size, context_focal or f, c, R, principal, f"context {k}"),
                     photo(rng, context_size))
                for k, (c, R) in enumerate(zip(centers, rotations))]
    return HardScene(target, contexts, waves(rng, size))


def with_depth(scene: HardScene, change) -> HardScene:
    """The depth as `change(depth, rng)` leaves it."""
    return replace(scene, depth=change(scene.depth.copy(), np.random.default_rng(5)))


def with_photos(make) -> HardScene:
    """All photos as `make(rng, (height, width, 3))` gives them: floating point from 0 to 1."""
    rng = np.random.default_rng(1)
    return base().mapped(lambda v: View(v.camera, make(rng, (v.camera.height, v.camera.width, 3)), v.mask))


def with_masks(target=None, context=None) -> HardScene:
    """Masks made by `target(shape)` and `context(shape)`."""
    def masked(v: View) -> View:
        make_mask = target if v.camera.name == "target" else context
        return View(v.camera, v.image, make_mask and make_mask((v.camera.height, v.camera.width)))

    return base().mapped(masked)


def moved(scale: float, offset=(0.0, 0.0, 0.0)) -> HardScene:
    """The base scene in other units and at another place."""
    def view(v: View) -> View:
        pose = v.camera.world_to_camera.copy()
        pose[:3, 3] = -pose[:3, :3] @ (v.camera.center * scale + np.asarray(offset, np.float64))
        return View(replace(v.camera, world_to_camera=pose), v.image, v.mask)

    return with_depth(base().mapped(view), lambda depth, rng: depth * scale)


def sprinkled(values) -> HardScene:
    """Some pixels with each of `values` for a depth."""
    def change(depth, rng):
        places = rng.permutation(depth.size)[:12 * len(values)]
        depth.ravel()[places] = np.resize(values, places.size)
        return depth

    return with_depth(base(), change)


def grazing() -> HardScene:
    """A plane, and context cameras that see it at about 3 degrees."""
    scene = base(centers=((0.97, 0.0, 0.93), (-0.85, 0.0, 0.95)), rotations=[turn(y=1.48), turn(y=-1.5)])
    return with_depth(scene, lambda d, rng: 1 + 1e-3 * rng.standard_normal(d.shape))


def within() -> HardScene:
    """A context camera in the middle of a deep scene: Gaussians in front of, on, near and behind its plane."""
    scene = base(centers=((0.03, 0.02, 1.0), (0.15, 0.0, 0.0)), rotations=[turn(y=0.05), turn(y=0.1)])
    return with_depth(scene, lambda d, rng: (d - d.mean()) * 6 + 1.1)


def crowded(width: int = 80, height: int = 60) -> HardScene:
    """A context camera so far that all Gaussians of the target fall into a few of its pixels."""
    return base(size=(width, height), centers=((0.4, 0.0, -90.0), (0.15, 0.0, 0.0)), rotations=[turn(), turn(y=0.1)],
                context_size=(21, 17), context_focal=(100.0, 100.0))
