"""Hard cases that need no other device: every setting at its limits."""

from collections.abc import Iterator

from support.hard_check import Outcome, run_case
from support.hard_scenes import base
from support.hard_table import CASES as HARD_SCENES
from support.hard_table import WHOLE, Case

ONE = ("order-free",)
_LIMITS = [
    ("splatting__radius", 0.0), ("splatting__radius", 0.5), ("splatting__radius", 1e-6),
    ("splatting__depth_slices", 1e-6), ("splatting__depth_relative", 1.0), ("splatting__depth_footprints", 1e6),
    ("splatting__low_pass", 4.0), ("splatting__low_pass", 1e-6), ("splatting__occlusion", False), ("loss__ssim", 0.0),
    ("loss__ssim", 1.0), ("loss__huber", 0.0), ("loss__huber", 1.0), ("loss__robust", 2.0), ("loss__robust", 1e-6),
]
_STEP_LIMITS = [
    ("smoothness__weight", 100.0), ("smoothness__huber", 1e-6), ("smoothness__huber", 1e6),
    ("smoothness__discontinuity", 1e-6), ("smoothness__discontinuity", 1e12), ("smoothness__texture", 1.0),
    ("smoothness__kind", "normal"), ("solver__rate", 100.0), ("solver__rate", 1e-12), ("solver__damping", 0.0),
    ("solver__damping", 1e3), ("solver__patience", 1), ("solver__patience", 10**6), ("solver__rate_floor", 0.0),
    ("solver__rate_floor", 1.0), ("solver__final_rate", 0.0), ("solver__views_per_step", 10**4),
    ("solver__max_move", 0.0), ("solver__tolerance", 0.0), ("solver__rate_unit", "distance"), ("solver__beta1", 0.0),
    ("solver__beta2", 0.0), ("solver__beta2", 0.9999), ("solver__gradient_filter", 0), ("solver__gradient_filter", 16),
    ("solver__mismatch", 0.0), ("solver__mismatch", 2.0), ("solver__early_damping", 1.0),
    ("solver__early_damping", 1e3), ("smoothness__specularity", 0.0), ("smoothness__specularity", 1e4),
    ("smoothness__full_views", 1), ("smoothness__full_views", 1000), ("splatting__final_radius", 0.5),
    ("smoothness__early", 0.0), ("solver__photos_first", 0.0), ("solver__photos_first", 1.0),
]
_SWITCHES = ("gradient_weight", "coverage_weight", "unseen_mask", "grey", "exposure", "structure", "target_view")
SETTINGS = [
    *(Case(f"{key.replace('__', '.')} = {value}", base, 2e-3 if "robust" in key else 1e-3, {key: value})
      for key, value in _LIMITS),
    *(Case(f"loss.{name} = {on}", base, 2e-3, {f"loss__{name}": on}, blends)
      for name in _SWITCHES for on, blends in ((True, ONE), (False, ("alpha",)))),
    Case("loss.shading = True", base, 2e-3, dict(loss__shading=True), ONE),
    Case("splatting.normalize = True", base, 1e-3, dict(splatting__normalize=True), ("alpha",)),
    Case("radius 8", base, 2e-3, dict(splatting__radius=8.0)),
    Case("depth threshold 0", base, 0.2, dict(splatting__depth_slices=1e9, splatting__depth_footprints=0.0),
         why=WHOLE),
    *(Case(f"{key.replace('__', '.')} = {value}", base, 1e-3, {key: value}, ONE) for key, value in _STEP_LIMITS),
    Case("pyramid down to one pixel", base, 1e-3, dict(pyramid__scales=(0.01, 1.0), pyramid__steps=(2, 2)), ONE),
    Case("pyramid down to one pixel, enlarged", base, 1e-3,
         dict(pyramid__scales=(0.01, 1.0), pyramid__steps=(2, 2), pyramid__carry_over=False), ONE),
    Case("no steps", base, 1e-3, dict(pyramid__steps=(0,), pyramid__scales=(1.0,))),
]
CASES = [*HARD_SCENES, *SETTINGS]


def run_cases(device) -> Iterator[Outcome]:
    """Every case with each of its blends, in order, as they come."""
    return (run_case(case, blend, device) for case in CASES for blend in case.blends)
