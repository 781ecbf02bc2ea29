"""`pagas-cl refine`: the whole way from a folder of photos to refined depth maps and a mesh."""

import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import typer

from pagas_cl.app.commands import _options as options
from pagas_cl.app.commands._given import Given, loaded, look, place_of, together
from pagas_cl.app.commands._process import nothing_refined, shown_progress, typed
from pagas_cl.app.commands._wanted import Wanted, check_fusion, check_times, within_time
from pagas_cl.app.report import Report
from pagas_cl.app.report.writer import proof, sentence
from pagas_cl.config import Config
from pagas_cl.config.presets import build_config, effect_settings
from pagas_cl.config.version import __version__
from pagas_cl.errors import InterruptedRunError, PagasError, log
from pagas_cl.jobs.finished import begun_in, records_in
from pagas_cl.jobs.place import Place
from pagas_cl.jobs.work_folder import check_names, claim_names, forget_inputs, one_run, remove_run
from pagas_cl.method.surface.agree import comparison_device
from pagas_cl.method.surface.keep_mesh import mesh_room
from pagas_cl.method.surface.mesh_options import MeshOptions
from pagas_cl.method.surface.raster import each_depth
from pagas_cl.progress import Progress, stage
from pagas_cl.refine import Refined, refine_scene
from pagas_cl.runtime.device import Device
from pagas_cl.runtime.host import trim
from pagas_cl.scene.depthmap import find_depth
from pagas_cl.scene.meshes.files import write_mesh
from pagas_cl.scene.meshes.kinds import to_surface
from pagas_cl.scene.readers import camera_file
from pagas_cl.scene.view import Scene, View, joined


def command(
    call: typer.Context,
    scene: Path = typer.Argument(..., metavar="SCENE", help="Folder with images/ and cameras (sparse/0, ...), or what "
                                 "a network, a phone or an RGB-D recording left."),
    mesh: Path = typer.Option(None, "--mesh", help="The coarse mesh; its depth is where the refinement starts. Without "
                              "it and --depth-dir: what SCENE holds."),
    output: Path = typer.Option(None, "--output", help="The refined mesh to write (.ply, .obj, .glb, .stl, .off)."),
    depth_dir: Path = options.DEPTH_DIR,
    save_depth: Path = typer.Option(None, "--save-depth", help="Folder for the refined depth maps, <image stem>.npz."),
    views: list[str] = typer.Option([], "--views", help="Refine these views only (several names may follow)."),
    hold_out: list[str] = typer.Option([], "--hold-out", help="Keep these photos out of everything, for 'pagas-cl "
                                                               "evaluate --held-out'."),
    context: int = typer.Option(None, "--context", help="Most context views of each view."),
    preset: str = typer.Option("balanced", "--preset", help="Settings to start from: fast, balanced, accurate, paper."),
    device: str = options.DEVICE,
    report: Path = typer.Option(None, "--report", help="Folder for pictures of every view and a page to open."),
    time_per_view: float = typer.Option(None, "--time-per-view", metavar="SECONDS", parser=options.above_zero,
                                        help="Not --preset: the best settings that take no longer here."),
    time_budget: float = typer.Option(None, "--time-budget", metavar="MINUTES", parser=options.above_zero,
                                      help="The same, for the refining of all views together."),
    settings: list[str] = typer.Option([], "--set", metavar="STAGE.FIELD=VALUE", help="Change one setting."),
    effects: list[str] = typer.Option([], "--effect", metavar="NAME=auto|on|off|set",
                                      help="Simulate an effect or not, such as exposure=off; see 'pagas-cl analyze'."),
    format: str = options.FORMAT,
    depth_scale: float = options.DEPTH_SCALE,
    outside: bool = options.OUTSIDE,
    photos: Path = options.PHOTOS,
    align: bool = typer.Option(True, "--align/--no-align", help="Align depth maps that disagree, in scale and shift, "
                               "before they are refined."),
    fuse: bool = typer.Option(False, "--fuse", help="Fuse a new mesh from the depth maps, not --mesh refined."),
    keep_mesh: bool = typer.Option(False, "--keep-mesh", help="Move the vertices of --mesh and keep its triangles."),
    allow_loss: bool = typer.Option(False, "--allow-loss",
                                    help="With --keep-mesh: go on though the new file cannot keep all of the mesh."),
    subdivide: float = typer.Option(None, "--subdivide", metavar="PIXELS", parser=options.above_zero,
                                    help="Split edges of --mesh down to so many pixels (1.5); with "
                                    "--keep-mesh all (none)."),
    tolerance: float = typer.Option(None, "--tolerance", metavar="PIXELS", parser=options.above_zero,
                                    help="How far off triangles of --mesh may be that need not be smaller (0.025, or "
                                    "as photos are unsure)."),
    triangles: int = typer.Option(None, "--triangles", metavar="N", help="Not --tolerance: this many triangles."),
    devices: str = options.DEVICES,
    scheduler: str = options.SCHEDULER,
    memory: float = typer.Option(None, "--memory", metavar="MB", parser=options.above_zero,
                                 help="Most host memory for the mesh; half of what is free by default (--fuse: all)."),
    color: bool = typer.Option(False, "--color", help="Colour the vertices of --mesh by the photos."),
    overwrite: bool = options.OVERWRITE,
    quiet: bool = options.QUIET,
):
    """Refine the depth of every view of SCENE with the other photos, and with it the mesh; or fuse a new one."""
    wanted = Wanted(mesh=mesh, depth_dir=depth_dir, output=output, save_depth=save_depth, report=report,
                    keep_mesh=keep_mesh, allow_loss=allow_loss, fuse=fuse, overwrite=overwrite, hold_out=hold_out,
                    numbers=MeshOptions(None, subdivide, tolerance, triangles, memory, color))
    wanted.check()
    check_times(time_per_view, time_budget, preset, several=devices is not None or scheduler is not None)
    settings = [*settings, *effect_settings(effects), *([] if context is None else [f"context.number={context}"])]
    config = build_config(preset, settings)
    given = look(scene, mesh=mesh, depth_dir=depth_dir, depth_scale=depth_scale, format=format, outside=outside,
                 photos=photos, names=views).without(hold_out)
    wanted.check_places(given)
    given.log()
    wanted = replace(wanted, mesh=given.mesh)
    wanted.check_mesh(given.scene.views)
    if wanted.making.output == "mesh":
        log.info("%s", mesh_room([given.scene.views[k].camera for k in given.requested], memory)[1])
    every = given.file_stems()
    stems = [every[k] for k in given.requested]
    if wanted.folder is not None:
        check_names(wanted.folder, stems, wanted.overwrite)
    place = Place(**place_of(device, devices, scheduler), folder=wanted.folder)
    in_time = partial(within_time, per_view=time_per_view, budget=time_budget, preset=preset, settings=settings)
    with (nothing_refined() as remarks, one_run(wanted.folder),
          _resumable(wanted.folder, len(stems), forget_inputs if wanted.save_depth else remove_run),
          one_run(wanted.next_to_mesh), one_run(report),
          _page(report, given.scene, place, call.obj or "", hold_out) if report else nullcontext() as page):
        try:
            _refine(wanted, given, config, stems, place, in_time, align, page, shown_progress(quiet))
        finally:
            if page is not None:
                page.notes += remarks


@contextmanager
def _resumable(folder: Path | None, total: int, forget: Callable[[Path], None]):
    """Context, inside one_run, of a run of `total` views that keeps finished ones in `folder`: says first what an
    earlier run has left there, and where it is interrupted (InterruptedRunError) what is kept now, and how to go on.
    Where it ends with no view finished, `forget` removes what was drawn."""
    def found() -> tuple[int, str]:
        """How many views are kept, and as what: those of the last round, or else of earlier ones."""
        done = len(records_in(folder)) if folder is not None else 0
        return (done, "finished") if done or folder is None else (begun_in(folder), "begun")

    left, how = found()
    if left:
        log.info("an earlier run has left %d %s view%s in %s: what would come out the same is not done again",
                 left, how, "" if left == 1 else "s", folder)
    try:
        yield
    except (PagasError, KeyboardInterrupt) as error:
        done, how = found()
        if folder is not None and not done:
            forget(folder)
        if isinstance(error, PagasError):
            raise
        what = (f"{done} of {total} views are {how} and kept in {str(folder)!r}: the same command goes on from them"
                if done else "nothing is kept, no view was finished" if folder is not None
                else "nothing is kept but pictures; with --save-depth finished views are")
        raise InterruptedRunError(f"interrupted; {what}") from error


def _page(folder: Path, found: Scene, place: Place, command: str, hold_out: list[str]) -> Report:
    where = place.executor or (place.device.info if isinstance(place.device, Device) else place.device)
    facts = [("scene", f"{found.source}, {len(found.views)} views"),
             *([("held out", ", ".join(hold_out))] if hold_out else [])]
    return Report(folder, "pagas-cl refine", facts=facts,
                  particulars=[("command", command), ("version", f"pagas_cl {__version__}"), ("device", str(where))],
                  began=time.monotonic(), hold_out=typed(hold_out))


def _refine(wanted: Wanted, given: Given, config: Config, stems: list[str], place: Place,
            in_time: Callable[..., tuple[Config, str]], align: bool, page: Report | None, progress: Progress) -> None:
    """Refine the views, make the mesh, and write what is wanted of both."""
    if config.effects.cameras == "set":
        log.info("cameras: taken as they are, not checked (--effect cameras=auto checks them, and refines what is off)")
    depths = None
    if wanted.mesh is None:
        depths = together(given, align)
        depths = depths if wanted.folder is not None else loaded(depths)

    def choose(views: list[View], depths: Sequence[Any], config: Config) -> Config:
        """The settings that the time allows, once cameras and depth maps are there; what is planned is checked."""
        config, settings = in_time(config, views, depths, given.names, place.device, progress)
        if page is not None:
            page.particulars.append(("settings", settings))
        if wanted.numbers.memory_mb is not None and wanted.fuses_mesh:
            check_fusion([views[k] for k in given.requested], [depths[k] for k in given.requested], config.fusion,
                         wanted.numbers.memory_mb)
        if wanted.overwrite and wanted.folder is not None:
            claim_names(wanted.folder, stems, wanted.overwrite)
        trim()
        return config

    making = replace(wanted.making, note=page and page.details.append)
    cameras = {view.name: view.camera for view in given.scene.views}
    done = refine_scene(given.scene.views, wanted.mesh and to_surface(wanted.mesh), depths, config, names=given.names,
                        place=place, choose=choose, making=making, progress=progress,
                        on_view=page and (lambda view, *found: page.add(view, *found, given=cameras[view.name])))
    if page is not None and done.cameras is not None:
        page.notes.append(str(done.cameras))
    _write(wanted, given.scene.views, done, place, page, progress)


def _write(wanted: Wanted, views: Sequence[View], done: Refined, place: Place, page: Report | None,
           progress: Progress) -> None:
    """Write the mesh and the cameras, show the mesh on the page, log what came out."""
    if wanted.output is not None:
        write_mesh(wanted.output, done.mesh)
        trim()
        if page is not None:
            with stage(progress, "show the mesh", 1) as showing:
                _show_mesh(page, done, wanted.mesh, place.device)
                showing.advance(1)
    if wanted.save_depth is not None:
        _save_cameras(wanted.save_depth, views, done.results)
    _log_results(done.results, wanted, done.mesh_limit)
    if wanted.folder is not None and wanted.save_depth is None:
        remove_run(wanted.folder)


def _show_mesh(page: Report, done: Refined, mesh: Path | None, device: Any) -> None:
    """Put the given and the made mesh on the page, seen from the view of which most was refined."""
    before, after = mesh and to_surface(mesh), to_surface(done.mesh)
    place, _ = max(joined(done.views, done.results), key=lambda pair: pair[1].counts["refined"])
    view = done.views[place]
    depths = before and [next(each_depth(surface, [view.camera], comparison_device(device)))
                         for surface in (before, after)]
    page.add_mesh(before, after, view=view, depths=depths)


def _save_cameras(folder: Path, views, results) -> None:
    """Next to the depth maps their cameras, refined or not; of depth maps of earlier runs theirs stay."""
    pairs = [(place, result) for place, result in joined(views, results) if "failed" not in result.report]
    own = [replace(views[place], camera=result.camera, mask=None) for place, result in pairs]
    used = {None, *(find_depth(folder, view.name) for view in own)}         # by depth map, which two photos may claim
    others = [entry for entry in camera_file.entries_in(folder) if find_depth(folder, entry["image"]) not in used]
    path = camera_file.write(folder, own, others)
    if any(result.camera is not views[place].camera for place, result in pairs):
        log.info("the refined cameras: %s", path)


def _log_results(results, wanted: Wanted, limit: str) -> None:
    """Say what came out, last the mesh and the `limit` that it met; an error where views were left out."""
    total = Counter()
    for result in results:
        total.update(result.counts)
    log.debug("pixels: %s", ", ".join(f"{number:,} {name}" for name, number in total.items()))
    reasons = [result.reason for result in results]
    log.info("%s", sentence([result.counts for result in results], reasons))
    if wanted.save_depth is not None:
        made = {result.name for result in results if "failed" not in result.report}
        left = sum(record.name not in made and (wanted.save_depth / f"{record.stem}.npz").exists()
                   for record in records_in(wanted.save_depth))
        log.info("the refined depth maps: %s%s", wanted.save_depth,
                 f" (with {left} more, of earlier runs: whatever reads the folder uses them, too)" if left else "")
    if wanted.report is not None:
        log.info("pictures and figures, to open in a browser: %s", wanted.report / "index.html")
    if wanted.output is not None:
        log.info("the refined mesh: %s%s", wanted.output, f" ({limit})" if limit else "")
    if said := proof([result.report for result in results], reasons, typed(wanted.hold_out)):
        log.info("%s", said)
    failed = [(r.name, r.report["failed"]) for r in results if "failed" in r.report]
    if failed:
        names = ", ".join(name for name, _ in failed[:10]) + (", ..." if len(failed) > 10 else "")
        raise PagasError(f"{len(failed)} of {len(results)} views failed and were left out: {names} ({failed[0][1]}); "
                         "the rest is done, start the same command again for these")
