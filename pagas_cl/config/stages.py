"""The settings of each stage of a run: one frozen dataclass a stage, which checks what it is given.

Lengths are free of scale: pixels, pixels of parallax, or shares of the depth range; never scene units, so that the
same settings serve millimetres and kilometres.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

from pagas_cl.config.rules import Stage, effect, is_whole, one_of, real, setting, switch, whole
from pagas_cl.errors import InputError, short

# context views: their cameras lie in 64 kB of constant memory, which every device has; more do not fit
MOST_CONTEXTS = 800
# bound of lambda_s (no unit; BALANCED has 0.12), whatever raises it
MOST_WEIGHT = 100.0
# bound of the factor by which what the depth does not explain of the photos, or specularity, raises lambda_s
MOST_RAISED = 40.0


@dataclass(frozen=True)
class Splatting(Stage):
    """How Gaussians become an image (method sections 3 and 4)."""

    blend: str = one_of("order_free", "order_free", "alpha")
    """Either "order_free": colours averaged by weight (Zwicker et al. 2001), smooth at all its bounds; or "alpha": the
    paper's front-to-back compositing."""
    radius: float = real(1.42, 0, 8)
    """Radius threshold r, pixels; the weights of "order_free" come to 0 there as (1 - (distance / r)^8)^2."""
    final_radius: float = real(0.0, 0, "radius")
    """r of the second half of a level's steps, at most `radius`; 0 keeps it."""
    occlusion: bool = switch(True)
    """Whether the depth threshold is tested at all."""
    depth_slices: float = real(40.0, 1e-6, 1e9)
    """The depth threshold (the paper's delta) is the range of the initial depth divided by this (paper: 20)."""
    depth_footprints: float = real(6.0, 0, 1e6)
    """The depth threshold is at least this many pixels of the context photo, in size on the surface; else a slope
    hides itself where the photo is coarse."""
    depth_relative: float = real(0.0, 0, 1)
    """Share of the local depth; the depth threshold is the smaller of both where this is above 0 (thin structures)."""
    low_pass: float = real(0.0, 0, 4)
    """Variance epsilon, px^2, added to the projected Gaussian, with the compensation factor on opacity ("antialiased");
    0 compiles both out."""
    normalize: bool = switch(False)
    """With "alpha": compare C / A instead of C."""


@dataclass(frozen=True)
class Loss(Stage):
    """What the splatted image is compared by (method section 5)."""

    ssim: float = real(0.4, 0, 1)
    """lambda_c, the share of 1 - SSIM; L1 has the rest."""
    huber: float = real(0.002, 0, 1)
    """Residuals up to this one, colours in 0 to 1, count quadratically in L1: where a residual is near 0 its sign is
    that of the last bit. 0 is plain L1."""
    grey: bool = switch(False, "GREY")
    """Compare grey images (Rec. 601 luma) instead of three channels."""
    exposure: bool = switch(False, "EXPOSURE")
    """Fit a gain and an offset of each channel between the target's photo and each context photo, in closed form and
    again as the depth improves, and compare after them."""
    structure: bool = switch(False, "STRUCTURE")
    """SSIM without its luminance term: a local offset of brightness, as a highlight leaves it, is not seen."""
    shading: bool = switch(False)
    """Take from each context photo what its colours differ by from the target's over whole surroundings, under the
    depth that the view starts from: light and haze that fall otherwise from place to place."""
    gradient_weight: bool = switch(False, "GRADIENT_WEIGHT")
    """Weight L1 by w_grad (paper eq. 6)."""
    coverage_weight: bool = switch(False, "COVERAGE_WEIGHT")
    """Weight L1 by the rendered coverage A."""
    unseen_mask: bool = switch(False, "UNSEEN_MASK")
    """Leave out the pixels that no valid target pixel reaches under the initial depth (L1 only)."""
    robust: float = real(0.0, 0, 2)
    """Windows with 1 - SSIM above this, and residuals above a quarter of it, count as a constant (shiny surfaces,
    moving things); 0 compiles it out."""
    target_view: bool = switch(False)
    """Count the target's own view in the reported loss (it has no gradient)."""


@dataclass(frozen=True)
class Smoothness(Stage):
    """What holds a depth map together where photos say little."""

    kind: str = one_of("planar", "none", "normal", "planar")
    """The penalty: "none"; "normal": the paper's angle between neighbouring normals; "planar": Huber on second
    differences of inverse depth, in pixels of parallax, which vanish on every plane."""
    weight: float = real(0.12, 0, MOST_WEIGHT)
    """lambda_s."""
    full_views: int = whole(10, 1, 1000)
    """With fewer context views than this the weight is larger, by (full_views / context views)^(2/3): fewer photos
    average less noise. 1 keeps it. Only once the photos have moved the depth (Solver.photos_first)."""
    early: float = real(1.0, 0, 1)
    """Share of the weight until then: with less a depth that is far off follows the photos further, and one that is
    nearly right follows their noise."""
    texture: float = real(0.0, 0, 1)
    """How much w_grad lowers the weight: 1 - texture * w_grad."""
    specularity: float = real(0.0, 0, 1e4)
    """Most by which the specularity that was measured around a pixel raises its weight; 0 leaves it out. Only once the
    photos have moved the depth, too."""
    huber: float = real(1.0, 1e-6, 1e6)
    """With "planar": where the penalty turns from quadratic to linear, pixels of parallax."""
    discontinuity: float = real(0.3, 1e-6, 1e12)
    """With "planar": a second difference beyond this, pixels of parallax, is a discontinuity and pulls no more; up to
    there its pull fades as (1 - (e / discontinuity)^8)^2."""

    def weight_with(self, contexts: int) -> float:
        """lambda_s where there are so many context views, at most the largest weight there is."""
        return min(MOST_WEIGHT, self.weight * float(max(1.0, self.full_views / contexts) ** (2 / 3)))


@dataclass(frozen=True)
class Solver(Stage):
    """Adam and its schedule (method section 6)."""

    rate: float = real(0.042, 1e-12, 100)
    """Step per iteration in `rate_unit`."""
    rate_unit: str = one_of("parallax", "parallax", "distance")
    """Either "parallax": pixels of parallax of each pixel; or "distance": the median distance of the cameras from the
    point they look at (the paper's)."""
    damping: float = real(6e-3, 0, 1e3)
    """Adam's epsilon, relative to a gradient of 1 per pixel of parallax (typical ones are 0.01 to 0.05): a gradient far
    below it moves a depth in proportion, not by a whole step in the direction of its sign."""
    early_damping: float = real(5.0, 1, 1e3)
    """The damping is so many times larger at a level's first step, and falls to 1 over the first fifth of them: the
    first gradients are the ones that Adam has no measure for yet."""
    beta1: float = real(0.9, 0, 0.9999)
    beta2: float = real(0.9, 0, 0.9999)
    """beta1, beta2: Adam's decay of the mean gradient and of the mean square, per step. A beta2 near 1 remembers the
    large gradients of the first steps for ever, and every later step is short."""
    gradient_filter: int = whole(2, 0, 16)
    """Radius, pixels, of the tent over which the gradient of the photos is averaged before each step: neighbours that
    are off together push together, noise does not. 0 leaves each pixel its own."""
    photos_first: float = real(0.42, 0, 1)
    """Share of a level's steps in which the photos move the depth, before smoothness is raised for few context views
    and specularity. Much smoothness takes out what the photos disagree on in tens of steps, but would let a depth that
    is far off follow them only over hundreds."""
    patience: int = whole(0, 0, 10**6)
    """Steps without a better loss before the rate falls by 10; 0 keeps the rate."""
    rate_floor: float = real(0.01, 0, 1)
    """A level stops when the rate falls below this share of the first one."""
    final_rate: float = real(0.3, 0, 1)
    """The rate falls linearly to this share of it over the last half of a level's steps; 1 keeps it."""
    views_per_step: int = whole(1, 0, 10**4)
    """Context views used in each step, in turn; 0 means all."""
    max_move: float = real(8.0, 0, 1e9)
    """A depth that moved by more than this, pixels of parallax, is rejected and the input kept."""
    tolerance: float = real(0.03, 0, 2)
    """A depth is rejected where its patches correlate worse with the context photos than the input's by more."""
    mismatch: float = real(0.45, 0, 2)
    """A depth is rejected where 1 - correlation is above this in its surroundings (15 x 15 pixels, mean): the photos do
    not show the same thing there. A view with more than two thirds rejected is returned unchanged, where fewer than
    three photos that took no part see it."""

    def damping_at(self, step: int, steps: int) -> float:
        """Of step 0, 1, ... of `steps`."""
        return self.damping * (1 + (self.early_damping - 1) * max(0.0, 1 - 5 * step / steps))

    def raised_from(self, steps: int) -> int:
        """The step, from 0, of `steps` that smoothness is raised before: 0 where the loss may end the level at any."""
        return 0 if self.patience else int(self.photos_first * steps)


@dataclass(frozen=True)
class Pyramid(Stage):
    """Levels from coarse to fine."""

    scales: tuple[float, ...] = setting((1.0,), lambda scales, _: (
        all(0 < a < b for a, b in zip(scales, scales[1:])) and scales[-1:] == (1,),
        "rising numbers above 0, the last one 1"))
    """Image size of each level as a share of the full size; the last one is 1."""
    steps: tuple[int, ...] = setting((150,), lambda steps, pyramid: (
        len(steps) == len(pyramid.scales) and all(is_whole(n, 0, 10**6) for n in steps),
        f"{len(pyramid.scales)} whole numbers from 0 to 1000000, one a scale"))
    """Most steps of each level."""
    carry_over: bool = switch(True)
    """Whether the depths that a level starts from move along with what the one before has found of their surface; else
    what that one has found is enlarged, as the paper does, which blurs edges and loses thin things."""
    far_off: tuple[float, ...] = setting((0.125, 0.25, 0.25, 0.5), lambda sizes, _: (
        len(sizes) > 0 and all(0 < size < 1 for size in sizes), "numbers between 0 and 1"))
    """Image sizes at which all views are refined first where the start is far off (effects.pyramid), as shares of the
    full size, with the steps of the last level; sizes below a half with twice as many, up to 300."""
    least_side: int = whole(320, 1, 10**6)
    """Sizes of far_off below a quarter are left out where a photo has fewer pixels along its longer side there."""

    def __post_init__(self) -> None:
        for name in ("scales", "steps", "far_off"):
            given = getattr(self, name)
            try:
                object.__setattr__(self, name, tuple(given if name == "steps" else map(float, given)))
            except (TypeError, ValueError) as error:
                raise InputError(f"setting pyramid.{name} is {short(given)}, expected a list of numbers") from error
        super().__post_init__()


@dataclass(frozen=True)
class Context(Stage):
    """Which other views constrain a view."""

    number: int = whole(10, 1, MOST_CONTEXTS)
    """Most context views."""
    min_angle: float = real(1.0, 0, 180)
    max_angle: float = real(60.0, "min_angle", 180)
    """min_angle, max_angle: useful angles between the rays of target and context, degrees."""
    min_overlap: float = real(0.1, 0, 1)
    """Least share of the target's valid pixels that a context view must see."""


@dataclass(frozen=True)
class Fusion(Stage):
    """Depth maps to a mesh."""

    voxel: float = real(1.5, 0.05, 1000)
    """Edge of a voxel in footprints (the median size of a pixel on the surface)."""
    truncation: float = real(6.0, 1, 100)
    """Truncation distance in voxels."""
    min_views: int = whole(1, 1, 1000)
    """Least number of views that must have seen a vertex."""
    agree_views: int = whole(0, 0, 1000)
    """Before fusion keep only depths that this many other views confirm; 0 keeps all."""
    agree_pixels: float = real(2.0, 0, 1e6)
    """What "confirm" means: within this many pixels of parallax."""
    least_weight: float = real(1.0, 0, 1)
    """What a depth counts, in thirds, however unsure it is: below 1 depths are weighted by their confidence, at 0 those
    that no photo speaks for are left out. A view that is sure then counts three times for `min_views`."""
    polish: bool = switch(False)
    """Whether the vertices of the fused mesh are put where the depth maps agree (method section 10): no ripples of
    voxels. Off: where depth maps contradict each other, its triangles fold. Needs an OpenCL device."""
    min_component: float = real(0.05, 0, 1)
    """Connected components with fewer triangles than this share of the largest one are dropped; 0 keeps all."""


@dataclass(frozen=True)
class Agreement(Stage):
    """Rounds after the first, in which refined depth maps are evidence for one another (method section 8.1)."""

    rounds: int = whole(0, 0, 20)
    """How often each depth is averaged with what its context views' depth maps say; 0: not at all."""
    steps: float = real(0.095, 0, 10)
    """Steps of the photos between two rounds, as a share of those of the last level; each is longer by 1.4."""
    pixels: float = real(2.0, 1e-3, 100)
    """A depth map that says something else by more than this, pixels of parallax, is of another surface."""


@dataclass(frozen=True)
class Effects(Stage):
    """Which effects are simulated (method section 8): "on", "off", "auto" (decided from measurements of the scene), or
    "set" (the settings of the other stages hold as they are). What each one sets, and on what evidence:
    pagas_cl.method.effects.decide."""

    occlusion: str = effect()
    unseen_mask: str = effect()
    exposure: str = effect()
    view_dependence: str = effect()
    shading: str = effect()
    antialiasing: str = effect()
    smoothness: str = effect()
    noise: str = effect()
    pyramid: str = effect()
    hypotheses: str = effect()
    mismatch: str = effect()
    resemblance: str = effect()
    consistency: str = effect()
    agreement: str = effect()
    cameras: str = effect()

    @property
    def measured(self) -> bool:
        """Whether a view is measured for them before it is refined: the others rest on refined depth maps, or come
        before (which views, their cameras)."""
        later = ("pyramid", "hypotheses", "mismatch", "resemblance", "consistency", "agreement", "cameras")
        return any(getattr(self, own.name) not in ("set", "off") for own in fields(self) if own.name not in later)

    @classmethod
    def every(cls, choice: str) -> Effects:
        """The same choice for all."""
        return cls(**{own.name: choice for own in fields(cls)})
