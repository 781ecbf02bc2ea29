"""`pagas-cl bench`: what a step and a frame cost on this device, stage by stage."""

import sys
from pathlib import Path

import typer

from pagas_cl.app.commands._options import OVERWRITE, QUIET
from pagas_cl.app.commands._outputs import check_outputs
from pagas_cl.app.commands._start import check_writable
from pagas_cl.app.synthetic import relief_scene
from pagas_cl.app.tradeoffs.bench import bench
from pagas_cl.config.assignments import build_config
from pagas_cl.scene.own_files import write_json


def command(
    preset: list[str] = typer.Option(["fast", "balanced", "paper"], "--preset", help="Presets to measure."),
    width: int = typer.Option(388, "--width", help="Width of the photos; the height is three quarters of it."),
    contexts: int = typer.Option(5, "--context", help="Context views."),
    repeats: int = typer.Option(3, "--repeat", min=1, help="Runs after the first; a frame's time is the best of them."),
    settings: list[str] = typer.Option([], "--set", help="stage.field=value, for all presets."),
    device: str = typer.Option(None, "--device", help="Part of an OpenCL device's name."),
    output: Path = typer.Option(None, "--json", help="Write all figures to this file too."),
    overwrite: bool = OVERWRITE,
    quiet: bool = QUIET,
):
    """Measure presets on a synthetic scene: time of each stage, bytes moved, share of the copy bandwidth, memory."""
    check_outputs({"--json": output}, {}, overwrite)
    check_writable("--json", output and output.parent)
    synthetic = relief_scene(width, round(width * 0.7477), contexts=contexts)
    depth, results = synthetic.initial_depth(synthetic.cameras[0]), []
    for name in preset:
        result = bench(synthetic.views, depth, name, build_config(name, settings), device, repeats)
        sys.stdout.write(result.table() + "\n")
        results.append(result.as_dict())
    if output:
        write_json(output, "bench", {"presets": results})
