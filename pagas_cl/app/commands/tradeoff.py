"""`pagas-cl tradeoff`: what accuracy costs in time on this device, for this scene."""

import sys
from pathlib import Path

import typer

from pagas_cl.app.commands import _options as options
from pagas_cl.app.commands._given import look
from pagas_cl.app.commands._outputs import check_outputs, page_files
from pagas_cl.app.commands._process import opened_device, shown_progress
from pagas_cl.app.tradeoffs import tradeoff
from pagas_cl.app.tradeoffs.page import closing, headline, markdown, notes
from pagas_cl.errors import InputError, plain
from pagas_cl.scene.own_files import is_own_json


def command(
    scene: Path = options.SCENE,
    mesh: Path = typer.Option(None, "--mesh", help="The coarse mesh; its depth is where the refinement starts."),
    depth_dir: Path = options.DEPTH_DIR,
    truth: Path = typer.Option(None, "--truth", help="True depth maps, <image stem>.npz, or a true mesh; else photos "
                                                     "that are held out of the refinement are the judge."),
    views: list[str] = typer.Option([], "--views", help="Measure on these views (several names may follow)."),
    held_out: list[str] = typer.Option([], "--held-out", help="Views kept out of everything, to be predicted."),
    sample: int = typer.Option(2, "--sample", help="Without --views: how many views to measure on."),
    budget: float = typer.Option(None, "--budget", metavar="MINUTES", parser=options.above_zero,
                                 help="Leave out what does not fit any more."),
    report: Path = typer.Option(None, "--report", help="Folder for tradeoff.json, the plot and a page to open; a "
                                                       "second run goes on where the first one ended."),
    repeats: int = typer.Option(1, "--repeats", help="Timed runs of each setting; the median counts."),
    device: str = options.DEVICE,
    format: str = options.FORMAT,
    depth_scale: float = options.DEPTH_SCALE,
    outside: bool = options.OUTSIDE,
    photos: Path = options.PHOTOS,
    overwrite: bool = options.OVERWRITE,
    quiet: bool = options.QUIET,
):
    """Run a plan of settings on a sample of views: error, time and memory of each, and the front of the best."""
    given = look(scene, mesh=mesh, depth_dir=depth_dir, depth_scale=depth_scale, format=format, outside=outside,
                 photos=photos, names=views)
    found = given.scene
    given.file_stems()
    plot = [] if report is None or is_own_json(report / "tradeoff.json") else ["tradeoff.png"]    # else it is known
    check_outputs(page_files(report, "tradeoff.json", plot, overwrite), [("--report", report)],
                  {**given.inputs, "--truth": truth}, overwrite)
    given.log()
    if truth is not None and not truth.exists():
        raise InputError(f"--truth {str(truth)!r} does not exist, expected a folder of depth maps or a mesh")
    opened = opened_device(device)
    progress = shown_progress(quiet)
    depths = given.initial_depths(progress, opened)
    true = truth and given.with_truth(truth, depth_scale).initial_depths(progress, opened)
    study = tradeoff(found.views, depths, truth=true, names=given.names, held_out=held_out or None, sample=sample,
                     budget=budget, device=opened, report=report, repeats=repeats, progress=progress)
    if not study.points:
        raise InputError(f"--budget {budget:g} minutes are too few for a single setting on this device: raise it, or "
                         "measure smaller photos")
    sys.stdout.write("\n".join(map(plain, [headline(study), *notes(study), "", ""])))
    sys.stdout.write(markdown(study.points))
    sys.stdout.write("".join(f"\n{line}\n" for line in closing(study)))
    if report is not None:
        sys.stdout.write(f"\nplot and page: {report / 'index.html'}\n")
