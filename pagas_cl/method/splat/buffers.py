"""What the device holds for one level, photos apart: one declaration that is planned, allocated and read from."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, prod, sqrt
from typing import TypeAlias

import numpy as np
import pyopencl as cl

from pagas_cl.config import Config
from pagas_cl.method.splat.constants import MARGIN, MOST_MOVED
from pagas_cl.method.splat.options import blocks, is_planar, pitch, reach
from pagas_cl.runtime.arena import Buffers, declared
from pagas_cl.scene.camera import Size

NO_HEAD = np.int32(-1)    # of an empty bin (alpha.cl)
SUM_GROUPS = 64           # groups that share the pixels of a smoothness loss
MOST_SAMPLES = 4096       # of an image, about; rows and columns are whole
_ZERO = np.uint32(0)
MaybeBuffer: TypeAlias = "cl.Buffer | None"      # None where no setting needs it


@dataclass(frozen=True)
class SampleGrid:
    """Samples of an image: `across` x `down` of them, `stride` pixels apart."""

    stride: int
    across: int
    down: int

    @classmethod
    def over(cls, size: Size) -> "SampleGrid":
        """At most about MOST_SAMPLES, never more than twice as many, however narrow the image."""
        stride = max(ceil(sqrt(size.pixels / MOST_SAMPLES)), ceil(max(size.width, size.height) / (2 * MOST_SAMPLES)), 1)
        return cls(stride, -(-size.width // stride), -(-size.height // stride))

    @property
    def count(self) -> int:
        return self.across * self.down

    @property
    def arguments(self) -> dict[str, int]:
        return {"stride": self.stride, "across": self.across, "count": self.count}


def channels_of(config: Config) -> int:
    return 1 if config.loss.grey else 3


def keeps_surfaces(config: Config, contexts: int) -> bool:
    """Whether context views keep z-buffers of their own: where depths move little enough until a view's next turn."""
    solver, splatting = config.solver, config.splatting
    a_step = min(solver.views_per_step or contexts, contexts)
    return (splatting.occlusion and splatting.blend == "order_free" and solver.rate_unit == "parallax"
            and contexts * solver.rate <= a_step * MOST_MOVED)


def dimensions(config: Config, target: Size, others: Sequence[Size], contexts: int) -> dict:
    """What the buffers of a level are made of, by the names that their fields below use: lengths, and whether an effect
    is on. `others` are all images but the target's, of which the first `contexts` are context views."""
    sizes, channels = (target, *others), channels_of(config)
    side = 2 * reach(config.splatting.radius) + 1
    smooth = config.smoothness.kind != "none"
    follows_loss = config.solver.patience > 0
    return dict(
        pixels=target.pixels, most_pixels=max(size.pixels for size in sizes), cameras=len(sizes), contexts=contexts,
        photos=1 + contexts, samples=SampleGrid.over(target).count, layers=channels + 1, places=side**2,
        bins=max((size.width + side) * (size.height + side) for size in sizes),
        partials=2 * (channels * max(pitch(size.width) * size.height for size in sizes) + 2 * MARGIN),
        seen_lengths=[size.pixels // 32 + 2 for size in others[:contexts]],
        losses=max(config.pyramid.steps) + 1,
        blocks=prod(blocks(target)),
        surfaces=[size.pixels for size in others[:contexts]] if keeps_surfaces(config, contexts) else [],
        occlusion=config.splatting.occlusion, alpha=config.splatting.blend == "alpha", ssim=config.loss.ssim > 0,
        exposure=config.loss.exposure, unseen_mask=config.loss.unseen_mask, smooth=smooth,
        filtered=config.solver.gradient_filter > 0 or is_planar(config), normal=config.smoothness.kind == "normal",
        follows_loss=follows_loss, specularity=smooth and config.smoothness.specularity > 0,
        follows_smooth=smooth and follows_loss)


@dataclass(eq=False)
class SurfaceBuffers(Buffers):
    """Where the target's depth lands in the context views; lengths in device units."""

    depth: MaybeBuffer = declared(("pixels",), np.float32, "units", "depth of each target pixel; 0: no surface")
    depth_per_parallax: MaybeBuffer = declared(
        ("pixels",), np.float32, "units", "depth that moves a pixel by one in the context views; 0: none sees it")
    cameras: MaybeBuffer = declared(("cameras", 20), np.float32, "", "as scene.camera.camera_table, the target first")
    z_first: MaybeBuffer = declared(
        ("most_pixels",), np.uint32, "units", "bits of the nearest depth in each pixel of the view at hand",
        needed="occlusion")
    row_ranges: MaybeBuffer = declared(
        ("blocks", 2), np.int32, "pixels", "first and last row of the view at hand that each block of pixels reaches")


@dataclass(eq=False)
class EvidenceBuffers(SurfaceBuffers):
    """What serves the steps, and the evidence after them."""

    rendered: MaybeBuffer = declared(
        ("most_pixels", "layers"), np.float32, "", "the view at hand: colour and coverage, or whole sums of them",
        start=_ZERO)
    v_rendered: MaybeBuffer = declared(("most_pixels", "layers"), np.float32, "1", "N dL/d rendered")


@dataclass(eq=False)
class ExposureBuffers(Buffers):
    exposure: MaybeBuffer = declared(
        ("photos", 2, 3), np.float32, "", "gain and offset by channel, of the target and each context view",
        needed="exposure")
    matches: MaybeBuffer = declared(
        ("contexts", "samples", 8), np.float32, "0 to 1", "colours of both photos at each sample (exposure.cl)",
        needed="exposure")


@dataclass(eq=False)
class LevelBuffers(EvidenceBuffers, ExposureBuffers):
    gradient: MaybeBuffer = declared(("pixels",), np.float32, "1 / units", "N dL/d depth of the photos", start=_ZERO)
    first: MaybeBuffer = declared(("pixels",), np.float32, "1", "Adam's mean of the gradient", start=_ZERO)
    second: MaybeBuffer = declared(("pixels",), np.float32, "1", "Adam's mean of its square", start=_ZERO)
    surfaces: tuple[cl.Buffer, ...] = declared(
        (), np.uint32, "units", "of each context view: z_first, kept for some steps", each="surfaces")
    state: MaybeBuffer = declared((8,), np.float32, "", "of the schedule, as in step.cl", start=_ZERO)
    partials: MaybeBuffer = declared(
        ("partials",), np.uint32, "1", "derivatives of SSIM by the means of its windows", needed="ssim")
    followed: MaybeBuffer = declared(
        ("pixels",), np.float32, "1 / units", "N dL/d depth that a step follows; None: `gradient`", needed="filtered")
    heads: MaybeBuffer = declared(
        ("bins",), np.int32, "", "first link of each bin; NO_HEAD: empty", needed="alpha", start=NO_HEAD)
    links: MaybeBuffer = declared(
        ("pixels", 2), np.int32, "", "next Gaussian of the bin, and the key of the depth", needed="alpha")
    alphas: MaybeBuffer = declared(
        ("places", "pixels"), np.float32, "0 to 1", "weight of a Gaussian in each pixel around, then N dL/d of it",
        needed="alpha")
    kappa: MaybeBuffer = declared(
        ("pixels",), np.float32, "pixels * units", "pixels of parallax per inverse depth", needed="smooth")
    weights: MaybeBuffer = declared(("pixels",), np.float32, "1", "of smoothness, by texture", needed="smooth")
    raised: MaybeBuffer = declared(
        (2 * MOST_SAMPLES,), np.float32, "1", "factors of the weights by specularity, on a grid over the target",
        needed="specularity")
    normals: MaybeBuffer = declared(("pixels", 4), np.float32, "1", "unit normals", needed="normal")
    slopes: MaybeBuffer = declared(("pixels", 4), np.float32, "1", "N dL_s/d normals", needed="normal")
    seen: tuple[cl.Buffer, ...] = declared(
        (), np.uint32, "", "of each context view: bits of the pixels that the initial depth covers",
        each="seen_lengths", needed="unseen_mask")
    loss: MaybeBuffer = declared(
        (1,), np.int64, "2^-40", "of the photos, summed over the views of a step", start=_ZERO, needed="follows_loss")
    smooth_losses: MaybeBuffer = declared(
        (SUM_GROUPS,), np.float32, "1", "parts of the loss of smoothness", needed="follows_smooth")
    history: MaybeBuffer = declared(("losses",), np.float32, "1", "loss of each step", needed="follows_loss")
