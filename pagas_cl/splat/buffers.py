"""What the device holds for one level beside photos: one declaration that is planned, allocated and read from."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, sqrt

import numpy as np
import pyopencl as cl

from pagas_cl.config import Config
from pagas_cl.runtime.arena import Buffers, declared
from pagas_cl.scene.camera import Camera
from pagas_cl.splat import tile as tiles
from pagas_cl.splat.options import reach

NO_HEAD = np.int32(-1)    # of an empty bin (alpha.cl)
SUM_GROUPS = 64           # groups that share the pixels of a smoothness loss
MOST_SAMPLES = 4096       # of an image, about; rows and columns are whole
_ZERO = np.uint32(0)


@dataclass(frozen=True)
class Size:
    """Width and height of an image in pixels."""

    width: int
    height: int

    @property
    def pixels(self) -> int:
        return self.width * self.height

    @property
    def grid(self) -> tuple[int, int]:
        return self.width, self.height

    @property
    def extent(self) -> dict[str, int]:
        """As kernels name it."""
        return {"width": self.width, "height": self.height}


def level_size(camera: Camera, scale: float) -> Size:
    """Image size of `camera` at the pyramid level `scale`."""
    return Size(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))


@dataclass(frozen=True)
class SampleGrid:
    """Samples of an image: `across` x `down` of them, `stride` pixels apart."""

    stride: int
    across: int
    down: int

    @classmethod
    def over(cls, size: Size) -> SampleGrid:
        """At most about MOST_SAMPLES, never more than twice as many, however narrow the image."""
        stride = max(ceil(sqrt(size.pixels / MOST_SAMPLES)), ceil(max(size.width, size.height) / (2 * MOST_SAMPLES)), 1)
        return cls(stride, -(-size.width // stride), -(-size.height // stride))

    @property
    def count(self) -> int:
        return self.across * self.down

    @property
    def arguments(self) -> dict[str, int]:
        """As kernels name them."""
        return {"stride": self.stride, "across": self.across, "count": self.count}


@dataclass(frozen=True)
class Dimensions:
    """What the shapes of the buffers of a level are made of: the sizes of `target` and of all `others`, of which the
    first `contexts` are context views."""

    config: Config
    target: Size
    others: list[Size]
    contexts: int

    @property
    def pixels(self) -> int:
        """N, of the target."""
        return self.target.pixels

    @property
    def most_pixels(self) -> int:
        """M, of the largest image."""
        return max(size.pixels for size in (self.target, *self.others))

    @property
    def cameras(self) -> int:
        return 1 + len(self.others)

    @property
    def exposures(self) -> int:
        return 1 + self.contexts

    @property
    def samples(self) -> int:
        return SampleGrid.over(self.target).count

    @property
    def layers(self) -> int:
        """Channels, and coverage."""
        return channels_of(self.config) + 1

    @property
    def partials(self) -> int:
        """Three by channel and pixel of the largest image, by rows that start on 16 bytes, with a margin."""
        rows = max(tiles.pitch(size.width) * size.height for size in (self.target, *self.others))
        return 3 * channels_of(self.config) * rows + 2 * tiles.MARGIN

    @property
    def places(self) -> int:
        """Bins that a Gaussian is listed in."""
        return (2 * reach(self.config.splatting.radius) + 1) ** 2

    @property
    def bins(self) -> int:
        """Of the largest image and the border around it."""
        border = 2 * reach(self.config.splatting.radius) + 1
        return max((size.width + border) * (size.height + border) for size in (self.target, *self.others))

    @property
    def masks(self) -> list[int]:
        """Words of 32 pixels of each context view."""
        return [size.pixels // 32 + 2 for size in self.others[:self.contexts]]

    @property
    def losses(self) -> int:
        return max(self.config.pyramid.steps) + 1


def channels_of(config: Config) -> int:
    """Channels that a view is rendered in."""
    return 1 if config.loss.grey else 3


@dataclass(eq=False)
class SurfaceBuffers(Buffers):
    """Where the target's depth lands in the context views; lengths in device units."""

    depth: cl.Buffer | None = declared(("pixels",), np.float32, "units", "depth of each target pixel; 0: no surface")
    depth_per_parallax: cl.Buffer | None = declared(
        ("pixels",), np.float32, "units", "depth that moves a pixel by one in the context views; 0: none sees it")
    cameras: cl.Buffer | None = declared(("cameras", 20), np.float32, "", "as scene.rig.camera_table, the target first")
    z_first: cl.Buffer | None = declared(
        ("most_pixels",), np.uint32, "units", "bits of the nearest depth in each pixel of the view at hand",
        needed=lambda config: config.splatting.occlusion)


@dataclass(eq=False)
class EvidenceBuffers(SurfaceBuffers):
    """What serves the steps, and the evidence after them."""

    rendered: cl.Buffer | None = declared(
        ("most_pixels", "layers"), np.float32, "", "the view at hand: colour (0 to 1) and coverage, or whole sums of them")
    v_rendered: cl.Buffer | None = declared(("most_pixels", "layers"), np.float32, "1", "N dL/d rendered")


@dataclass(eq=False)
class ExposureBuffers(Buffers):
    """Gains and offsets of photos."""

    exposure: cl.Buffer | None = declared(
        ("exposures", 2, 3), np.float32, "", "gain and offset by channel, of the target and each context view",
        needed=lambda config: config.loss.exposure)
    matches: cl.Buffer | None = declared(
        ("contexts", "samples", 8), np.float32, "0 to 1", "colours of both photos at each sample, as exposure.cl has them",
        needed=lambda config: config.loss.exposure)


def _alpha(config):
    return config.splatting.blend == "alpha"


def _smooth(config):
    return config.smoothness.kind != "none"


def _normal(config):
    return config.smoothness.kind == "normal"


@dataclass(eq=False)
class LevelBuffers(EvidenceBuffers, ExposureBuffers):
    """What the steps of a level work on."""

    gradient: cl.Buffer | None = declared(("pixels",), np.float32, "1 / units", "N dL/d depth", start=_ZERO)
    first: cl.Buffer | None = declared(("pixels",), np.float32, "1", "Adam's mean of the gradient", start=_ZERO)
    second: cl.Buffer | None = declared(("pixels",), np.float32, "1", "Adam's mean of its square", start=_ZERO)
    state: cl.Buffer | None = declared((8,), np.float32, "", "of the schedule, as in step.cl", start=_ZERO)
    partials: cl.Buffer | None = declared(
        ("partials",), np.float32, "1", "derivatives of SSIM by the means of its windows",
        needed=lambda config: config.loss.ssim > 0)
    sums: cl.Buffer | None = declared(
        ("pixels",), np.float32, "1", "the gradient averaged across, per pixel of parallax",
        needed=lambda config: config.solver.gradient_filter > 0)
    heads: cl.Buffer | None = declared(
        ("bins",), np.int32, "", "first link of each bin; NO_HEAD: empty", needed=_alpha, start=NO_HEAD)
    links: cl.Buffer | None = declared(("pixels", 2), np.int32, "", "next Gaussian of the bin, and the key of the depth", needed=_alpha)
    alphas: cl.Buffer | None = declared(
        ("places", "pixels"), np.float32, "0 to 1", "weight of a Gaussian in each pixel around, then N dL/d of it",
        needed=_alpha)
    kappa: cl.Buffer | None = declared(
        ("pixels",), np.float32, "pixels * units", "pixels of parallax per inverse depth", needed=_smooth)
    weights: cl.Buffer | None = declared(("pixels",), np.float32, "1", "of smoothness, by texture", needed=_smooth)
    raised: cl.Buffer | None = declared(
        (2 * MOST_SAMPLES,), np.float32, "1", "factors of the weights by specularity, on a grid over the target",
        needed=lambda config: _smooth(config) and config.smoothness.specularity > 0)
    normals: cl.Buffer | None = declared(("pixels", 4), np.float32, "1", "unit normals", needed=_normal)
    slopes: cl.Buffer | None = declared(("pixels", 4), np.float32, "1", "N dL_s/d normals", needed=_normal)
    seen: tuple[cl.Buffer, ...] = declared(
        (), np.uint32, "", "of each context view: bits of the pixels that the initial depth covers", each="masks",
        needed=lambda config: config.loss.unseen_mask)
    loss: cl.Buffer | None = declared(
        (1,), np.int64, "2^-40", "of the photos, summed over the views of a step", start=_ZERO,
        needed=lambda config: config.solver.patience > 0)
    smooth_losses: cl.Buffer | None = declared(
        (SUM_GROUPS,), np.float32, "1", "parts of the loss of smoothness",
        needed=lambda config: config.solver.patience > 0 and _smooth(config))
    history: cl.Buffer | None = declared(
        ("losses",), np.float32, "1", "loss of each step", needed=lambda config: config.solver.patience > 0)
