"""The paper's ablation study as a plan, and its table: each row is one change of a base.

The paper's figures are of DTU scan 24 (Chamfer distance, mm, its full method 0.456 to 0.458) as far as they are known
here; a row without one says so.
"""

from __future__ import annotations

from pagas_cl.tradeoffs.plan import OWN_ERROR, RANDOM, Setting, changed, fixed

_UNKNOWN = "not quoted"
_FULL = "0.456-0.458"


def ablation_plan(base_name: str = "paper") -> list[Setting]:
    """Every row for the preset `base_name`, the base itself first."""
    base = fixed(base_name)
    steps = base.pyramid.steps[-1]
    rows = [Setting(base_name, (base,), "ablation", paper=_FULL if base_name == "paper" else "")]

    def add(name, paper=_UNKNOWN, **settings):
        rows.append(changed(f"{base_name}: {name}", "ablation", base, paper, **settings))

    add("initial depth per view", initial=OWN_ERROR)
    add("random initial depth", "worse", initial=RANDOM)
    for number in (1, 2, 3, 5, 7, 9):
        add(f"{number} context view{'s' * (number > 1)}", "0.465 (worse), 4x faster, 2 GB for 8" if number == 1 else
            "between 1 view and 10", context__number=number)
    if len(base.pyramid.scales) > 1:
        add("one level", "0.460 (worse)", pyramid__scales=(1.0,), pyramid__steps=(steps,))
    else:
        add("half size first", "0.456-0.458 for 0.460", pyramid__scales=(0.5, 1), pyramid__steps=(steps, steps))
    add("scales 4, 2, 1", "0.495 (worse)", pyramid__scales=(0.25, 0.5, 1), pyramid__steps=(100, 100, 100))
    add("steps 200, 100", pyramid__scales=(0.5, 1), pyramid__steps=(200, 100))
    add("steps 100, 200", pyramid__scales=(0.5, 1), pyramid__steps=(100, 200))
    rate = 1e-4 if base.solver.unit == "distance" else 10 * base.solver.rate
    add("rate 1e-4" if base.solver.unit == "distance" else "ten times the rate", "0.563 (worse)", solver__rate=rate)
    add("radius 3", "0.461 (worse)", splatting__radius=3.0)
    add("4 slices", splatting__depth_slices=4.0)
    add("no occlusion", "0.464 (worse)", splatting__occlusion=False)
    if base.smoothness.kind == "none":
        add("smoothness on normals", smoothness__kind="normal", smoothness__weight=0.01)
    else:
        add("no smoothness", smoothness__kind="none", smoothness__weight=0.0)
    add("SSIM 0.8", loss__ssim=0.8)
    add("exposure", effects__exposure="on")
    add("view-dependent colour (robust loss)", effects__view_dependence="on")
    add("stereo consistency of 2 views", agree=2)
    return rows


def ablation_table(points) -> str:
    """The rows as a Markdown table; errors as shares of the initial depth's."""
    lines = ["| change | depth error | normal error | s per view | device MB | paper: Chamfer, mm |",
             "|---|---|---|---|---|---|"]
    for p in points:
        missing = p.errors.get("missing", 0)
        kept = f" ({1 - missing:.0%} of the pixels kept)" if missing > 0.005 else ""
        lines.append(f"| {p.name}{kept} | {_share(p, 'depth')} | {_share(p, 'normal')} | {p.seconds:.3g} | "
                     f"{p.device_bytes / 1e6:.0f} | {p.paper} |")
    return "\n".join(lines) + "\n"


def _share(point, which) -> str:
    return f"{point.error(which):.3f}" if which in point.errors else "-"
