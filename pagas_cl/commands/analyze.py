"""`pagas-cl analyze`: which effects a scene calls for, on what evidence, and what each costs on this device."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import typer

from pagas_cl.commands._console import shown_progress
from pagas_cl.commands._start import check_source, check_writable, initial_depths, load_scene
from pagas_cl.scene.files import write_text

MANY = ("--views", "--set", "--effect")
COLUMNS = ["view", "effect", "evidence", "threshold", "decision", "what is measured"]
COSTS = ["effect", "off, ms a view", "on, ms a view", "device memory, bytes"]


def command(
    scene: Path = typer.Argument(..., metavar="SCENE", help="Folder with images/ and cameras (sparse/0, ...)."),
    mesh: Path = typer.Option(None, "--mesh", help="The coarse mesh; its depth is where a refinement would start."),
    depth_dir: Path = typer.Option(None, "--depth-dir", help="Initial depth maps, <image stem>.npz, not --mesh."),
    views: list[str] = typer.Option([], "--views", help="Analyze these views only (several names may follow)."),
    output: Path = typer.Option(None, "--json", help="Write everything to this file."),
    report: Path = typer.Option(None, "--report", help="Folder for a page to open."),
    preset: str = typer.Option("balanced", "--preset", help="Settings to start from: balanced, accurate, ..."),
    settings: list[str] = typer.Option([], "--set", metavar="STAGE.FIELD=VALUE", help="Change one setting."),
    effects: list[str] = typer.Option([], "--effect", metavar="NAME=auto|on|off|set", help="As in refine."),
    costs: bool = typer.Option(True, "--costs/--no-costs", help="Time some steps with each effect on and off."),
    device: str = typer.Option(None, "--device", help="Part of an OpenCL device's name; see 'pagas-cl devices'."),
    format: str = typer.Option(None, "--format", help="Format of SCENE, where looking at it is not enough."),
    depth_scale: float = typer.Option(None, "--depth-scale", help="Number for one scene unit in the depth files."),
    outside: bool = typer.Option(False, "--outside", help="Allow files outside SCENE (scenes that you trust)."),
    quiet: bool = typer.Option(False, "--quiet", help="No progress."),
):
    """Measure what SCENE calls for; refines nothing. The decisions are those that refine takes."""
    from pagas_cl.analysis import analyze
    from pagas_cl.commands._settings import build_config, effect_settings

    check_source(mesh, depth_dir, "where a refinement would start")
    config = build_config(preset, [*settings, *effect_settings(effects)])
    found = load_scene(scene, format, outside)
    names = [found.views[found.index(name)].name for name in views] or None
    check_writable("--json", output and output.parent)
    check_writable("--report", report)
    with shown_progress(quiet) as progress:
        depths = initial_depths(found, mesh, depth_dir, depth_scale, progress, names=names)
        analysis = analyze(found.views, depths, names=names, config=config, device=device, costs=costs,
                           progress=progress)
    show(analysis)
    text = json.dumps(analysis.as_dict(), indent=1) + "\n"
    if output is not None:
        write_text(output, text)
    if report is not None:
        write_text(report / "analysis.json", text)
        write_text(report / "index.html", page(analysis, found.source))


def rows(analysis) -> list[list[str]]:
    """One row a view and effect, as COLUMNS says; a view that has no context view has one row with the reason."""
    def row(view, decision, more=""):
        return [view, decision.effect, f"{decision.evidence:.4g}", f"{decision.threshold:g}",
                "on" if decision.on else "off", decision.reason + more]

    cells = []
    for view in analysis.views:
        if view.reason and not view.decisions:
            cells.append([view.view, "", "", "", "", view.reason])
        cells += [row(view.view, decision) for decision in view.decisions]
    if analysis.cameras is not None:
        cells.append(row("all", analysis.cameras, "; refined before the views where pairs that take no part agree"))
    if analysis.consistency is not None:
        cells.append(row("all", analysis.consistency, "; of the initial depth, decided anew on the refined one"))
    return cells


def cost_rows(analysis) -> list[list[str]]:
    """One row an effect, as COSTS says."""
    return [[name, f"{1e3 * c.off:.1f}", f"{1e3 * c.on:.1f}", f"{c.device_bytes:,}"]
            for name, c in analysis.costs.items()]


def show(analysis) -> None:
    """The tables on standard output."""
    from rich.console import Console
    from rich.table import Table

    out = Console(file=sys.stdout, width=None if sys.stdout.isatty() else 160, highlight=False)
    tables = [("What the scene calls for", COLUMNS, rows(analysis)),
              (f"Steps of {analysis.timed} on {analysis.device}", COSTS, cost_rows(analysis))]
    for title, columns, cells in tables[:1 + bool(analysis.costs)]:
        table = Table(*columns, title=title, title_justify="left")
        for row in cells:
            table.add_row(*row, style="bold" if "on" in row[4:5] else None)
        out.print(table)


def page(analysis, source: str) -> str:
    """The same as a page."""
    from pagas_cl.report.page import html_page

    notes = [f"scene: {source}, {len(analysis.views)} views", f"device: {analysis.device}"]
    notes += [f"{name}: {off} ms a view without, {on} ms with it, {size} bytes on the device ({analysis.timed})"
              for name, off, on, size in cost_rows(analysis)]
    sections = [(v.view, [], [v.reason] if v.reason else ["context views: " + ", ".join(v.contexts)])
                for v in analysis.views]
    return html_page("pagas-cl analyze", notes, COLUMNS, rows(analysis), sections)
