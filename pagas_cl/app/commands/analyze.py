"""`pagas-cl analyze`: which effects a scene needs, on what evidence, and what each costs on this device."""

import sys
from pathlib import Path
from textwrap import wrap

import typer

from pagas_cl.app.analysis import analyze
from pagas_cl.app.commands import _options as options
from pagas_cl.app.commands._given import look
from pagas_cl.app.commands._outputs import check_outputs
from pagas_cl.app.commands._process import opened_device, shown_progress
from pagas_cl.config.presets import build_config, effect_settings
from pagas_cl.errors import plain
from pagas_cl.method.effects.decide import EFFECTS
from pagas_cl.scene.own_files import write_json

WIDTH = 80
_MEASURABLE = 0.03     # share of a view's time, below which a difference is none


def command(
    scene: Path = options.SCENE,
    mesh: Path = typer.Option(None, "--mesh", help="The coarse mesh; its depth is where a refinement would start."),
    depth_dir: Path = options.DEPTH_DIR,
    views: list[str] = typer.Option([], "--views", help="Analyze these views only (several names may follow)."),
    table: bool = typer.Option(False, "--table", help="Also one line a view and effect, and the cost of each."),
    output: Path = typer.Option(None, "--json", help="Write everything to this file."),
    preset: str = typer.Option("balanced", "--preset", help="Settings to start from: balanced, accurate, ..."),
    settings: list[str] = typer.Option([], "--set", metavar="STAGE.FIELD=VALUE", help="Change one setting."),
    effects: list[str] = typer.Option([], "--effect", metavar="NAME=auto|on|off|set", help="As in refine."),
    costs: bool = typer.Option(True, "--costs/--no-costs", help="Time some steps with each effect on and off."),
    device: str = options.DEVICE,
    format: str = options.FORMAT,
    depth_scale: float = options.DEPTH_SCALE,
    outside: bool = options.OUTSIDE,
    overwrite: bool = options.OVERWRITE,
    quiet: bool = options.QUIET,
):
    """Measure which effects SCENE needs; refines nothing. The decisions are those that refine takes."""
    config = build_config(preset, [*settings, *effect_settings(effects)])
    given = look(scene, mesh=mesh, depth_dir=depth_dir, depth_scale=depth_scale, format=format, outside=outside,
                 names=views)
    check_outputs([("--json", output)], [], given.inputs, overwrite)
    given.log()
    progress = shown_progress(quiet)
    device = opened_device(device)
    depths = given.initial_depths(progress, device)
    analysis = analyze(given.scene.views, depths, names=given.names, config=config, device=device, costs=costs,
                       progress=progress)
    show(analysis, table)
    if output is not None:
        write_json(output, "analyze", analysis.as_dict())


def rows(analysis) -> list[list[str]]:
    """One row a view and effect: view, effect, evidence, threshold, decision, what is measured; a view that has no
    context view has one row with the reason."""
    def row(view, decision, more=""):
        return [view, decision.effect, f"{decision.evidence:.4g}", f"{decision.threshold:g}",
                "on" if decision.on else "off", decision.reason + more]

    cells = []
    for view in analysis.views:
        if view.reason and not view.decisions:
            cells.append([view.view, "", "", "", "", view.reason])
        cells += [row(view.view, decision) for decision in view.decisions]
    if analysis.pyramid is not None:
        cells.append(row("all", analysis.pyramid, "; smaller sizes first, where it is on"))
    if analysis.cameras is not None:
        cells.append(row("all", analysis.cameras, "; refined before the views where pairs that take no part agree"))
    if analysis.consistency is not None:
        cells.append(row("all", analysis.consistency, "; of the initial depth, decided anew on the refined one"))
    return cells


def summary(analysis) -> list[str]:
    """Lines of at most WIDTH columns: which effects are on, in how many views, on what evidence, at what cost."""
    return [line for head, text in _paragraphs(analysis) for line in wrap(
        text, WIDTH, initial_indent=head, subsequent_indent=" " * len(head)) or [""]]


def _paragraphs(analysis) -> list[tuple[str, str]]:
    """What stands at the head of each paragraph of the summary, and its text."""
    decided = [decision for view in analysis.views for decision in view.decisions]
    of_scene = (analysis.pyramid, analysis.cameras, analysis.consistency)
    decided += [decision for decision in of_scene if decision is not None]
    without = sum(not view.decisions for view in analysis.views)
    lines = [("", f"{len(analysis.views)} views" + (f", {without} of them not to be refined (--table says why)"
                                                    if without else ""))]
    for on, what in ((True, "Needed:"), (False, "Not needed:")):
        of = {}
        for decision in decided:
            if decision.on == on:
                of.setdefault(decision.effect, []).append(decision)
        lines += [("", ""), ("", what)] if of else []
        for name, found in of.items():
            total = sum(d.effect == name for d in decided)
            where = f"{len(found)} of {total} view{'s' if total > 1 else ''}" if name in EFFECTS else "scene"
            lines.append((f"  {name:<16}{where:<15}", f"{_why(found)}{_cost_of(analysis, name)}"))
    return lines + ([("", ""), ("", f"Costs: of {analysis.timed}, on {analysis.device}.")] if analysis.costs else [])


def _cost_of(analysis, name: str) -> str:
    cost = analysis.costs.get(name)
    if cost is None:
        return ""
    more = cost.on - cost.off
    time = f"{seconds(more)} a view" if more > _MEASURABLE * cost.off else "no time to speak of"
    return f"; costs {time}" + (f", {size(cost.device_bytes)}" if cost.device_bytes else "")


def _why(decisions) -> str:
    """Reason, evidence and threshold of decisions on one effect."""
    first, values = decisions[0], sorted(number(d.evidence) for d in decisions if d.evidence == d.evidence)
    effect = EFFECTS.get(first.effect)
    limit = f"on {'below' if effect and not effect.above else 'above'} {first.threshold:g}"
    seen = " to ".join(dict.fromkeys((values[0], values[-1]))) if values else "not measured"
    return f"{first.reason}: {seen} ({limit})"


def number(value: float) -> str:
    """Three digits, no exponent."""
    return f"{value:.3f}" if abs(value) < 1 else f"{value:.3g}"


def seconds(value: float) -> str:
    """A time as people say it."""
    return f"{value:.2g} s" if value >= 0.995 else f"{1e3 * value:.0f} ms"


def size(nbytes: float) -> str:
    """A number of bytes as people say it."""
    return f"{nbytes / 1e6:.1f} MB" if abs(nbytes) >= 1e5 else f"{nbytes / 1e3:.0f} kB"


def show(analysis, table: bool = False) -> None:
    """The summary on standard output, and with `table` one line a view and effect, one an effect."""
    lines = summary(analysis)
    if table:
        lines += ["", f"{'view':<29} {'effect':<16}{'evidence':>10}{'threshold':>11}  decision"]
        for view, effect, evidence, threshold, decision, reason in rows(analysis):
            line = f"{view[-29:]:<29} {effect:<16}{evidence:>10}{threshold:>11}  {decision}"
            lines.append(line.rstrip() if effect else f"{view[-29:]:<29} {reason}"[:WIDTH])
        if analysis.costs:
            lines += ["", f"{'effect':<16}{'without it':>12}{'with it':>12}{'memory':>12}  a view"]
        lines += [f"{name:<16}{seconds(cost.off):>12}{seconds(cost.on):>12}{size(cost.device_bytes):>12}"
                  for name, cost in analysis.costs.items()]
    sys.stdout.write("\n".join(map(plain, [*lines, ""])))
