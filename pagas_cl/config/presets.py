"""The presets; what each setting means is said in pagas_cl/config/__init__.py."""

from dataclasses import replace

from pagas_cl.config import Agreement, Config, Effects, Loss, Pyramid, Smoothness, Solver, Splatting
from pagas_cl.errors import InputError, check_kind

# What the published DTU experiments use (arXiv 2604.22129): the yardstick, not a recommendation.
PAPER = Config(
    splatting=Splatting(blend="alpha", radius=1.42, depth_slices=20.0, depth_footprints=0.0, low_pass=0.3),
    loss=Loss(ssim=0.2, huber=0.0, gradient_weight=True, coverage_weight=True, unseen_mask=True, target_view=True),
    smoothness=Smoothness(kind="none", weight=0.0, full_views=1),
    solver=Solver(rate=1e-5, rate_unit="distance", damping=1e-8, early_damping=1.0, beta2=0.999, gradient_filter=0,
                  final_rate=1.0, patience=10, views_per_step=0, max_move=1e9, tolerance=2.0, mismatch=2.0),
    pyramid=Pyramid(scales=(0.5, 1.0), steps=(100, 100)),
    agreement=Agreement(steps=0.08),
    effects=Effects.every("set"),
)
# The knee of the front of error against time (`pagas-cl tradeoff`; the tables are in docs/benchmarks.md): one context
# view a step, in turn, is as good per step as all of them; five times the steps gain 2 percent with ten context views,
# 7 with one. Steps x rate / damping is how far it converges, rate / damping at most 7 that rounding stays rounding.
BALANCED = Config()
# Gives up colour, most steps, two context views and the measuring of effects (photos of one exposure, a depth within a
# pixel or two of parallax): 1.2 to 2.5 times the error of "balanced" in a quarter of its time or less.
FAST = replace(BALANCED.with_settings(
    loss__grey=True, smoothness__discontinuity=0.5, solver__rate=0.16, solver__damping=1e-3, solver__early_damping=1.0,
    solver__beta1=0.7, solver__gradient_filter=3, solver__photos_first=0.5, solver__final_rate=0.1,
    pyramid__steps=(20,), pyramid__far_off=(0.125, 0.25), context__number=8, agreement__steps=0.08),
    effects=replace(Effects.every("set"), pyramid="auto"))
# Past the knee: five times the steps, shorter ones, and less smoothing; 1.6 to 7 percent less error.
ACCURATE = BALANCED.with_settings(smoothness__weight=0.1, smoothness__discontinuity=0.25, solver__rate=0.008,
                                  solver__damping=3e-3, solver__early_damping=1.0, solver__photos_first=0.5,
                                  pyramid__steps=(800,), agreement__steps=0.08)
PRESETS: dict[str, Config] = {"fast": FAST, "balanced": BALANCED, "accurate": ACCURATE, "paper": PAPER}


def preset(name: str) -> Config:
    """The preset called `name`: "fast", "balanced", "accurate" or "paper"; InputError for any other."""
    check_kind("preset", name, (str,), f"a name, one of {', '.join(PRESETS)}")
    if name not in PRESETS:
        raise InputError(f"unknown preset {name!r}, expected {' or '.join(map(repr, PRESETS))}")
    return PRESETS[name]


def settings_of(name: str | None, config: Config | None) -> Config:
    """What a caller's `preset` and `config` ask for: one of the two, the preset "balanced" where both are None."""
    if config is None:
        return preset("balanced" if name is None else name)
    if not isinstance(config, Config):
        raise InputError(f"config is a {type(config).__name__}, expected pagas_cl.Config (start from "
                         f"pagas_cl.preset({name or 'balanced'!r}))")
    if name is not None:
        raise InputError(f"preset {name!r} and a config were given, expected one of the two: change what "
                         f"pagas_cl.preset({name!r}) returns by its with_settings, and give that as config")
    return config
