"""The paper's ablation study as a plan, and its table: each row is one change of a base.

The paper's figures are of DTU scan 24 (Chamfer distance, mm, its full method 0.456 to 0.458) as far as they are known
here; the other rows of its table have none.
"""

from __future__ import annotations

from pagas_cl.tradeoffs.plan import OWN_ERROR, RANDOM, Setting, changed, fixed

_UNKNOWN = "-"
_FULL = "0.456-0.458"
_SAME = 0.02      # relative changes of an error below this count as none


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
    rate = 1e-4 if base.solver.rate_unit == "distance" else 10 * base.solver.rate
    add("rate 1e-4" if base.solver.rate_unit == "distance" else "ten times the rate", "0.563 (worse)",
        solver__rate=rate)
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
    """The rows as a Markdown table, beside what the paper says; `points` hold the base, whose name has no colon.

    Errors are shares of the initial depth's: of depth and normals, or, without truth, of what held-out photos say.
    "here" compares the first of them with the base's.
    """
    base = next((p for p in points if ":" not in p.name), None)
    named = (("depth", "depth error"), ("normal", "normal error"), ("unpredicted", "held-out photos"))
    figures = [(key, name) for key, name in named if any(key in p.errors for p in points)]
    header = ["change", *(name for _, name in figures), "here", "s per view", "device MB", "paper"]
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    for p in points:
        cells = [_name(p), *(_figure(p.error(key)) for key, _ in figures), _compared(p, base, figures[0][0]),
                 f"{p.seconds:.3g}", f"{p.device_bytes / 1e6:.0f}", p.paper]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def _name(point) -> str:
    missing = point.errors.get("missing", 0)
    kept = f" ({1 - missing:.0%} of the pixels kept)" if missing > 0.005 else ""
    return point.name.rpartition(": ")[2] + kept


def _figure(error: float) -> str:
    return f"{error:.3f}" if error == error else "-"


def _compared(point, base, key) -> str:
    if base is None or point is base:
        return ""
    change = point.error(key) / base.error(key) - 1
    if change != change:
        return "-"
    return "same" if abs(change) < _SAME else f"{'worse' if change > 0 else 'better'}, {change:+.0%}"
