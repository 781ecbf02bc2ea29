"""`pagas-cl demo`: a small scene with known geometry, refined on whatever device there is."""

import sys
from pathlib import Path

import typer

from pagas_cl.app.commands import _options as options
from pagas_cl.app.commands._outputs import check_writable
from pagas_cl.app.commands._process import opened_device, shown_progress
from pagas_cl.app.demo import run_demo
from pagas_cl.errors import InputError
from pagas_cl.jobs.work_folder import one_run


def command(
    output: Path = typer.Option(Path("demo_out"), "--output", help="Folder for the scene, the pictures and the mesh."),
    width: int | None = typer.Option(None, "--width", help="Width of the photos; the height is three quarters of it.",
                                     show_default="288, 388 with --hard"),
    contexts: int | None = typer.Option(None, "--context", help="Context views.", show_default="4, 5 with --hard"),
    preset: str = typer.Option("balanced", "--preset", help="Settings to refine with."),
    device: str = options.DEVICE,
    bar: float = typer.Option(0.0, "--bar", parser=options.zero_or_more, metavar="PIXELS",
                              help="Width in pixels of a thin bar in front."),
    hard: bool = typer.Option(False, "--hard", help="A start that is far off: steps and a bar, which the coarse mesh "
                                                    "rounds and lacks (needs Open3D)."),
    overwrite: bool = options.OVERWRITE,
    quiet: bool = options.QUIET,
):
    """Make a scene, refine it, show the errors before and after, pictures and the mesh."""
    check_writable("--output", output)
    taken = [output / name for name in ("scene", "report", "mesh_refined.ply") if (output / name).exists()]
    by_a_demo = (output / "scene" / "depth_true").is_dir()
    if taken and not by_a_demo and not overwrite:
        raise InputError(f"--output: {str(taken[0])!r} was not written by pagas_cl: choose another folder, or replace "
                         "it with --overwrite")
    opened = opened_device(device)  # before the scene is made: no seconds of work where there is none
    with one_run(output):
        result = run_demo(output, width=width, contexts=contexts, preset=preset,
                          device=opened, progress=shown_progress(quiet), bar=bar, hard=hard)
    sys.stdout.write(result.table())
    sys.stdout.write(f"refined in {result.seconds:.1f} s\npictures: {result.page}\n")
    if result.mesh is not None:
        sys.stdout.write(f"mesh: {result.mesh}\n")
