"""All settings of a run: one frozen dataclass a stage, which checks what it is given, and Config, which holds them.

Lengths are free of scale: pixels, pixels of parallax, or shares of the depth range; never scene units, so that the
same settings serve millimetres and kilometres.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from typing import Any

from pagas_cl.errors import InputError

# cameras of a view, its contexts and held-out views, lie in 64 kB of constant memory, which every device has
MOST_CONTEXTS, MOST_WEIGHT = 800, 100.0

# a value, whether it holds, what is expected
_Rule = tuple[object, bool, str]


def _check(stage: str, **rules: _Rule) -> None:
    """Raise InputError for the first `field=(value, holds, expected)` that does not hold."""
    for name, (value, holds, expected) in rules.items():
        if not holds:
            raise InputError(f"setting {stage}.{name} is {value!r}, expected {expected}")


def _one_of(value: object, *choices: str) -> _Rule:
    return value, value in choices, " or ".join(repr(c) for c in choices)


def _within(value: object, low: float, high: float) -> _Rule:
    ok = isinstance(value, (int, float)) and not isinstance(value, bool) and low <= value <= high
    return value, ok, f"a number from {low:g} to {high:g}"


def _whole(value: object, low: int, high: int) -> _Rule:
    ok = isinstance(value, int) and not isinstance(value, bool) and low <= value <= high
    return value, ok, f"a whole number from {low} to {high}"


def _flag(value: object) -> _Rule:
    return value, isinstance(value, bool), "true or false"


@dataclass(frozen=True)
class Splatting:
    """How Gaussians become an image (method sections 3 and 4).

    Attributes
    ----------
    blend : str
        "order_free": colours averaged by weight (Zwicker et al. 2001), smooth at all its bounds; "alpha": the paper's
        front-to-back compositing.
    radius : float
        Radius threshold r, pixels; the weights of "order_free" come to 0 there as (1 - (distance / r)^8)^2.
    final_radius : float
        r of the second half of a level's steps, at most `radius`; 0 keeps it.
    occlusion : bool
        Whether the depth threshold is tested at all.
    depth_slices : float
        The depth threshold delta is the range of the initial depth divided by this (paper: 20).
    depth_footprints : float
        delta is at least this many pixels of the context photo, in size on the surface; else a slope hides itself
        where the photo is coarse.
    depth_relative : float
        Share of the local depth; delta is the smaller of both where this is above 0 (thin structures).
    low_pass : float
        Variance epsilon, px^2, added to the projected Gaussian, with the compensation factor on opacity
        ("antialiased"); 0 compiles both out.
    normalize : bool
        With "alpha": compare C / A instead of C.
    """

    blend: str = "order_free"
    radius: float = 1.42
    final_radius: float = 0.0
    occlusion: bool = True
    depth_slices: float = 40.0
    depth_footprints: float = 6.0
    depth_relative: float = 0.0
    low_pass: float = 0.0
    normalize: bool = False

    def __post_init__(self) -> None:
        _check("splatting", blend=_one_of(self.blend, "order_free", "alpha"), radius=_within(self.radius, 0, 8),
               final_radius=_within(self.final_radius, 0, self.radius if isinstance(self.radius, (int, float)) else 8),
               occlusion=_flag(self.occlusion), depth_slices=_within(self.depth_slices, 1e-6, 1e9),
               depth_relative=_within(self.depth_relative, 0, 1),
               depth_footprints=_within(self.depth_footprints, 0, 1e6), low_pass=_within(self.low_pass, 0, 4),
               normalize=_flag(self.normalize))


@dataclass(frozen=True)
class Loss:
    """What the splatted image is compared by (method section 5).

    Attributes
    ----------
    ssim : float
        lambda_c, the share of 1 - SSIM beside L1.
    huber : float
        Residuals up to this one, colours in 0 to 1, count quadratically in L1: where a residual is near 0 its sign is
        that of the last bit. 0 is plain L1.
    gradient_weight : bool
        Weight L1 by w_grad (paper eq. 6).
    coverage_weight : bool
        Weight L1 by the rendered coverage A.
    unseen_mask : bool
        Leave out the pixels that no valid target pixel reaches under the initial depth (L1 only).
    grey : bool
        Compare grey images (Rec. 601 luma) instead of three channels.
    exposure : bool
        Fit a gain and an offset of each channel between the target's photo and each context photo, in closed form
        and again as the depth improves, and compare after them.
    structure : bool
        SSIM without its luminance term: a local offset of brightness, as a highlight leaves it, is not seen.
    robust : float
        Windows with 1 - SSIM above this, and residuals above a quarter of it, count as a constant (shiny surfaces,
        moving things); 0 compiles it out.
    target_view : bool
        Count the target's own view in the reported loss (it has no gradient).
    """

    ssim: float = 0.4
    huber: float = 0.002
    gradient_weight: bool = False
    coverage_weight: bool = False
    unseen_mask: bool = False
    grey: bool = False
    exposure: bool = False
    structure: bool = False
    robust: float = 0.0
    target_view: bool = False

    def __post_init__(self) -> None:
        _check("loss", ssim=_within(self.ssim, 0, 1), huber=_within(self.huber, 0, 1),
               robust=_within(self.robust, 0, 2),
               **{name: _flag(getattr(self, name)) for name in ("gradient_weight", "coverage_weight", "unseen_mask",
                                                                "grey", "exposure", "structure", "target_view")})


@dataclass(frozen=True)
class Smoothness:
    """What holds a depth map together where photos say little.

    Attributes
    ----------
    kind : str
        "none"; "normal": the paper's angle between neighbouring normals; "planar": Huber on second differences of
        inverse depth, in pixels of parallax, which vanish on every plane.
    weight : float
        lambda_s.
    full_views : int
        With fewer context views than this the weight is larger, by (full_views / context views)^(2/3): fewer photos
        average less noise. 1 keeps it. Only once the photos have moved the depth (Solver.photos_first).
    texture : float
        How much w_grad lowers the weight: 1 - texture * w_grad.
    specularity : float
        Most by which the specularity that was measured around a pixel raises its weight; 0 leaves it out. Only once the
        photos have moved the depth, too.
    huber : float
        With "planar": where the penalty turns from quadratic to linear, pixels of parallax.
    discontinuity : float
        With "planar": a second difference beyond this, pixels of parallax, is a discontinuity and pulls no more; up to
        there its pull fades as (1 - (e / discontinuity)^8)^2.
    """

    kind: str = "planar"
    weight: float = 0.12
    full_views: int = 10
    texture: float = 0.0
    specularity: float = 0.0
    huber: float = 1.0
    discontinuity: float = 0.3

    def __post_init__(self) -> None:
        _check("smoothness", kind=_one_of(self.kind, "none", "normal", "planar"),
               weight=_within(self.weight, 0, MOST_WEIGHT), full_views=_whole(self.full_views, 1, 1000),
               texture=_within(self.texture, 0, 1), specularity=_within(self.specularity, 0, 1e4),
               huber=_within(self.huber, 1e-6, 1e6), discontinuity=_within(self.discontinuity, 1e-6, 1e12))

    def weight_with(self, contexts: int) -> float:
        """lambda_s where there are so many context views, at most the largest weight there is."""
        return min(MOST_WEIGHT, self.weight * float(max(1.0, self.full_views / contexts) ** (2 / 3)))


@dataclass(frozen=True)
class Solver:
    """Adam and its schedule (method section 6).

    Attributes
    ----------
    rate : float
        Step per iteration in `rate_unit`.
    rate_unit : str
        "parallax": pixels of parallax of each pixel; "distance": the median distance of the cameras from the point
        they look at (the paper's).
    damping : float
        Adam's epsilon, relative to a gradient of 1 per pixel of parallax (typical ones are 0.01 to 0.05): a gradient
        far below it moves a depth in proportion, not by a whole step in the direction of its sign.
    early_damping : float
        The damping is so many times larger at a level's first step, and falls to 1 over the first fifth of them: the
        first gradients are the ones that Adam has no measure for yet.
    beta1, beta2 : float
        Adam's decay of the mean gradient and of the mean square, per step. A beta2 near 1 remembers the large gradients
        of the first steps for ever, and every later step is short.
    gradient_filter : int
        Radius, pixels, of the tent over which the gradient of the photos is averaged before each step: neighbours that
        are off together push together, noise does not. 0 leaves each pixel its own.
    patience : int
        Steps without a better loss before the rate falls by 10; 0 keeps the rate.
    rate_floor : float
        A level stops when the rate falls below this share of the first one.
    final_rate : float
        The rate falls linearly to this share of it over the last half of a level's steps; 1 keeps it.
    views_per_step : int
        Context views used in each step, in turn; 0 means all.
    max_move : float
        A depth that moved by more than this, pixels of parallax, is rejected and the input kept.
    tolerance : float
        A depth is rejected where its patches correlate worse with the context photos than the input's by more.
    mismatch : float
        A depth is rejected where 1 - correlation is above this in its surroundings (15 x 15 pixels, mean): the photos
        do not show the same thing there. A view with more than two thirds rejected is returned as it came.
    """

    rate: float = 0.035
    rate_unit: str = "parallax"
    damping: float = 6e-3
    early_damping: float = 5.0
    beta1: float = 0.9
    beta2: float = 0.9
    gradient_filter: int = 2
    patience: int = 0
    rate_floor: float = 0.01
    final_rate: float = 0.3
    views_per_step: int = 1
    max_move: float = 8.0
    tolerance: float = 0.03
    mismatch: float = 0.45

    def __post_init__(self) -> None:
        _check("solver", rate=_within(self.rate, 1e-12, 100), rate_unit=_one_of(self.rate_unit, "parallax", "distance"),
               damping=_within(self.damping, 0, 1e3), early_damping=_within(self.early_damping, 1, 1e3),
               beta1=_within(self.beta1, 0, 0.9999), beta2=_within(self.beta2, 0, 0.9999),
               gradient_filter=_whole(self.gradient_filter, 0, 16), patience=_whole(self.patience, 0, 10**6),
               rate_floor=_within(self.rate_floor, 0, 1), views_per_step=_whole(self.views_per_step, 0, 10**4),
               final_rate=_within(self.final_rate, 0, 1), max_move=_within(self.max_move, 0, 1e9),
               tolerance=_within(self.tolerance, 0, 2), mismatch=_within(self.mismatch, 0, 2))

    def damping_at(self, step: int, steps: int) -> float:
        """Of step 0, 1, ... of `steps`."""
        return self.damping * (1 + (self.early_damping - 1) * max(0.0, 1 - 5 * step / steps))

    def photos_first(self, steps: int) -> int:
        """Steps of a level before smoothness is raised for few context views and specularity: half of them, in which
        the photos move the depth. Much smoothness takes out what the photos disagree on in tens of steps, but would
        let a depth that is far off follow them only over hundreds. 0 where the loss may end the level at any step."""
        return 0 if self.patience else steps // 2


@dataclass(frozen=True)
class Pyramid:
    """Levels from coarse to fine.

    Attributes
    ----------
    scales : tuple of float
        Image size of each level as a share of the full size; the last one is 1.
    steps : tuple of int
        Most steps of each level.
    """

    scales: tuple[float, ...] = (1.0,)
    steps: tuple[int, ...] = (180,)

    def __post_init__(self) -> None:
        object.__setattr__(self, "scales", tuple(float(s) for s in self.scales))
        object.__setattr__(self, "steps", tuple(self.steps))
        rising = all(a < b for a, b in zip(self.scales, self.scales[1:]))
        ok = bool(self.scales) and rising and self.scales[0] > 0 and self.scales[-1] == 1
        _check("pyramid", scales=(self.scales, ok, "rising numbers above 0, the last one 1"),
               steps=(self.steps, len(self.steps) == len(self.scales)
                      and all(_whole(n, 0, 10**6)[1] for n in self.steps),
                      f"{len(self.scales)} whole numbers from 0 to 1000000, one a scale"))


@dataclass(frozen=True)
class Context:
    """Which other views constrain a view.

    Attributes
    ----------
    number : int
        Most context views.
    min_angle, max_angle : float
        Useful angles between the rays of target and context, degrees.
    min_overlap : float
        Least share of the target's valid pixels that a context view must see.
    """

    number: int = 10
    min_angle: float = 1.0
    max_angle: float = 60.0
    min_overlap: float = 0.1

    def __post_init__(self) -> None:
        _check("context", number=_whole(self.number, 1, MOST_CONTEXTS), min_angle=_within(self.min_angle, 0, 180),
               max_angle=_within(self.max_angle, self.min_angle, 180), min_overlap=_within(self.min_overlap, 0, 1))


@dataclass(frozen=True)
class Fusion:
    """Depth maps to a mesh.

    Attributes
    ----------
    voxel : float
        Edge of a voxel in footprints (the median size of a pixel on the surface).
    truncation : float
        Truncation distance in voxels.
    min_views : int
        Least number of views that must have seen a vertex.
    agree_views : int
        Before fusion keep only depths that this many other views confirm; 0 keeps all.
    agree_pixels : float
        What "confirm" means: within this many pixels of parallax.
    least_weight : float
        What a depth counts, in thirds, however unsure it is: below 1 depths are weighted by their confidence, at 0
        those that no photo speaks for are left out. A view that is sure then counts three times for `min_views`.
    min_component : float
        Pieces with fewer triangles than this share of the largest one are dropped; 0 keeps all.
    """

    voxel: float = 1.5
    truncation: float = 6.0
    min_views: int = 1
    agree_views: int = 0
    agree_pixels: float = 2.0
    least_weight: float = 1.0
    min_component: float = 0.05

    def __post_init__(self) -> None:
        _check("fusion", voxel=_within(self.voxel, 0.05, 1000), truncation=_within(self.truncation, 1, 100),
               min_views=_whole(self.min_views, 1, 1000), agree_views=_whole(self.agree_views, 0, 1000),
               agree_pixels=_within(self.agree_pixels, 0, 1e6), least_weight=_within(self.least_weight, 0, 1),
               min_component=_within(self.min_component, 0, 1))


@dataclass(frozen=True)
class Effects:
    """Which effects are simulated (method section 8): "on", "off", "auto" (decided from measurements of the scene), or
    "set" (the settings of the other stages hold as they are).

    Attributes
    ----------
    occlusion, unseen_mask, exposure, view_dependence, antialiasing, smoothness, noise, pyramid, consistency : str
        See pagas_cl.effects, which says what each one sets, and on what evidence.
    """

    occlusion: str = "auto"
    unseen_mask: str = "auto"
    exposure: str = "auto"
    view_dependence: str = "auto"
    antialiasing: str = "auto"
    smoothness: str = "auto"
    noise: str = "auto"
    pyramid: str = "auto"
    consistency: str = "auto"

    def __post_init__(self) -> None:
        _check("effects", **{f.name: _one_of(getattr(self, f.name), "auto", "on", "off", "set") for f in fields(self)})

    @property
    def measured(self) -> bool:
        """Whether a view is measured for them; the consistency check rests on other measurements."""
        return any(getattr(self, f.name) not in ("set", "off") for f in fields(self) if f.name != "consistency")

    @classmethod
    def every(cls, choice: str) -> Effects:
        """The same choice for all."""
        return cls(**{f.name: choice for f in fields(cls)})


@dataclass(frozen=True)
class Config:
    """All settings of a run: one of the dataclasses above a stage, equal and hashable by value."""

    splatting: Splatting = field(default_factory=Splatting)
    loss: Loss = field(default_factory=Loss)
    smoothness: Smoothness = field(default_factory=Smoothness)
    solver: Solver = field(default_factory=Solver)
    pyramid: Pyramid = field(default_factory=Pyramid)
    context: Context = field(default_factory=Context)
    fusion: Fusion = field(default_factory=Fusion)
    effects: Effects = field(default_factory=Effects)

    def __post_init__(self) -> None:
        for stage in fields(self):
            value = getattr(self, stage.name)
            if not is_dataclass(value) or type(value).__name__ != stage.type:
                raise InputError(f"setting {stage.name} is a {type(value).__name__}, expected a {stage.type}")

    def with_settings(self, **settings: Any) -> Config:
        """A copy with `stage__field=value` or `"stage.field": value` changed: `with_settings(splatting__radius=1.4)`.

        Raises
        ------
        InputError
            No such setting (the nearest one is named), or a value out of range.
        """
        by_stage: dict[str, dict[str, Any]] = {}
        for key, value in settings.items():
            key = key.replace("__", ".")
            if key not in setting_names():
                raise InputError(f"unknown setting {key!r}; {_nearest(key)}")
            stage, _, name = key.partition(".")
            by_stage.setdefault(stage, {})[name] = value
        return replace(self, **{stage: replace(getattr(self, stage), **values) for stage, values in by_stage.items()})

    def as_dict(self) -> dict[str, dict[str, Any]]:
        """Plain nested dictionary, ready for JSON."""
        return asdict(self)


def setting_names() -> list[str]:
    """Every setting as "stage.field", in order."""
    return [f"{stage.name}.{f.name}" for stage in fields(Config) for f in fields(globals()[str(stage.type)])]


def _nearest(key: str) -> str:
    from difflib import get_close_matches

    near = get_close_matches(key, setting_names(), n=1, cutoff=0.0)
    return f"the nearest known one is {near[0]!r}"
