"""`pagas-cl refine`: the whole way from a folder of photos to refined depth maps and a mesh."""

import time
from collections import Counter
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import typer

from pagas_cl.app.commands._console import noted, nothing_refined, shown_progress
from pagas_cl.app.commands._given import look, together
from pagas_cl.app.commands._memory import check_fusion, log_memory
from pagas_cl.app.commands._options import DEPTH_SCALE, OVERWRITE, QUIET, above_zero
from pagas_cl.app.commands._outputs import check_outputs, scene_inputs
from pagas_cl.app.commands._settings import check_times, config_in_time
from pagas_cl.app.commands._start import (
    check_report,
    check_source,
    check_writable,
    loaded,
    place_of,
    resumable,
)
from pagas_cl.app.jobs.finished import check_names, claim_names, one_run, remove_run
from pagas_cl.app.jobs.task import view_digest
from pagas_cl.app.report import Report, picture_files
from pagas_cl.app.report.headline import sentence
from pagas_cl.config import Config
from pagas_cl.config.assignments import apply_settings, build_config, effect_settings
from pagas_cl.config.version import __version__
from pagas_cl.errors import InputError, PagasError, log, need
from pagas_cl.method.effects.decide import Decision
from pagas_cl.method.surface.agree import comparison_device
from pagas_cl.method.surface.keep_mesh import check_kept, check_subdivide
from pagas_cl.method.surface.raster import each_depth
from pagas_cl.progress import stage
from pagas_cl.refine import MeshOptions, Place, Refined, refine_scene
from pagas_cl.result import DepthResult
from pagas_cl.runtime.device import Device
from pagas_cl.runtime.host import trim
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.joined import joined
from pagas_cl.scene.mesh_file import check_digits_of_scene, check_mesh_path, write_mesh
from pagas_cl.scene.mesh_kinds import to_surface
from pagas_cl.scene.names import file_stems
from pagas_cl.scene.readers import camera_file
from pagas_cl.scene.view import View


@nothing_refined()
def command(
    call: typer.Context,
    scene: Path = typer.Argument(..., metavar="SCENE", help="Folder with images/ and cameras (sparse/0, ...), or what "
                                 "a network, a phone or an RGB-D recording left."),
    mesh: Path = typer.Option(None, "--mesh", help="The coarse mesh; its depth is where the refinement starts. Without "
                              "it and --depth-dir: what SCENE holds."),
    output: Path = typer.Option(None, "--output", help="The refined mesh to write (.ply, .obj, .glb, .stl, .off)."),
    depth_dir: Path = typer.Option(None, "--depth-dir", help="Initial depth maps, <image stem>.npz, not --mesh."),
    save_depth: Path = typer.Option(None, "--save-depth", help="Folder for the refined depth maps, <image stem>.npz."),
    views: list[str] = typer.Option([], "--views", help="Refine these views only (several names may follow)."),
    hold_out: list[str] = typer.Option([], "--hold-out", help="Keep these photos out of everything, for 'pagas-cl "
                                                               "evaluate --held-out'."),
    context: int = typer.Option(None, "--context", help="Most context views of each view."),
    preset: str = typer.Option("balanced", "--preset", help="Settings to start from: fast, balanced, accurate, paper."),
    device: str = typer.Option(None, "--device", help="Part of an OpenCL device's name; see 'pagas-cl devices'."),
    report: Path = typer.Option(None, "--report", help="Folder for pictures of every view and a page to open."),
    time_per_view: float = typer.Option(None, "--time-per-view", metavar="SECONDS", parser=above_zero,
                                        help="Not --preset: the best settings that take no longer here."),
    time_budget: float = typer.Option(None, "--time-budget", metavar="MINUTES", parser=above_zero,
                                      help="The same, for the refining of all views together."),
    settings: list[str] = typer.Option([], "--set", metavar="STAGE.FIELD=VALUE", help="Change one setting."),
    effects: list[str] = typer.Option([], "--effect", metavar="NAME=auto|on|off|set",
                                      help="Simulate an effect or not, such as exposure=off; see 'pagas-cl analyze'."),
    format: str = typer.Option(None, "--format", help="Format of SCENE, where looking at it is not enough."),
    depth_scale: float = DEPTH_SCALE,
    outside: bool = typer.Option(False, "--outside", help="Allow files outside SCENE (scenes that you trust)."),
    photos: Path = typer.Option(None, "--photos", help="Folder of the original photos, where SCENE has a network's "
                                "small ones."),
    align: bool = typer.Option(True, "--align/--no-align", help="Align depth maps that disagree, in scale and shift, "
                               "before they are refined."),
    fuse: bool = typer.Option(False, "--fuse", help="Fuse a new mesh from the depth maps, not --mesh refined."),
    keep_mesh: bool = typer.Option(False, "--keep-mesh", help="Move the vertices of --mesh and keep its triangles."),
    allow_loss: bool = typer.Option(False, "--allow-loss",
                                    help="With --keep-mesh: go on though the new file cannot keep all of the mesh."),
    subdivide: float = typer.Option(None, "--subdivide", metavar="PIXELS", parser=above_zero,
                                    help="Split edges of --mesh down to so many pixels (1.5); with "
                                    "--keep-mesh all (none)."),
    devices: str = typer.Option(None, "--devices", metavar="all|NAME,...",
                                help="One process on each of these devices."),
    scheduler: str = typer.Option(None, "--scheduler", metavar="tcp://HOST:PORT", help="A running Dask cluster; "
                                  "one that you trust, since it may run any program here."),
    memory: float = typer.Option(None, "--memory", metavar="MB", parser=above_zero,
                                 help="Most host memory for the mesh; what is free by default."),
    overwrite: bool = OVERWRITE,
    quiet: bool = QUIET,
):
    """Refine the depth of every view of SCENE with the other photos, and with it the mesh; or fuse a new one."""
    _check_request(mesh, depth_dir, output, save_depth, report, keep_mesh, subdivide, fuse, outside)
    check_times(time_per_view, time_budget, preset, several=devices is not None or scheduler is not None)
    settings = [*settings, *effect_settings(effects)]
    more = {} if context is None else {"context__number": context}
    config = build_config(preset, settings, **more)
    given = look(scene, mesh=mesh, depth_dir=depth_dir, depth_scale=depth_scale, format=format, outside=outside,
                 photos=photos, names=views or None).without(hold_out, views)
    _check_places(scene, given, mesh, depth_dir, photos, output, save_depth, report, overwrite)
    found, mesh = given.scene, given.mesh
    for line in given.lines():
        log.info("%s", line)
    if mesh is None and given.depths is None:
        raise InputError(f"{str(scene)!r} holds neither depth maps nor a mesh: expected either --mesh or --depth-dir "
                         "(where the refinement starts), got neither")
    kept = None not in (output, mesh) and not fuse
    if kept:
        check_kept(output, mesh, allow_loss or not keep_mesh)
    elif output is not None:
        check_digits_of_scene(output, np.array([view.camera.center for view in found.views]))
        need("open3d", "mesh", "fusing depth maps to a mesh (--output without --mesh, or with --fuse)")
    as_given, cameras = found.views, {view.name: view.camera for view in found.views}
    for view in as_given:
        view.check_files()
    names = [found.views[found.index(name)].name for name in views] or None
    pictures = picture_files(names or [view.name for view in found.views], None not in (output, mesh))
    check_report(report, "report.json", pictures, overwrite)
    # finished views are kept with the depth maps, or next to the mesh until it is written; with all that a later run
    # may need of them, so that nothing is refined again for it
    folder = output.parent / f".{output.name}.views" if save_depth is None and output is not None else save_depth
    stems = [stem for view, stem in zip(found.views, file_stems([view.name for view in found.views]))
             if names is None or view.name in names]      # names that no file can have are refused here
    if folder is not None:
        check_names(folder, stems, overwrite)
    if memory is not None and (output is None or (keep_mesh and subdivide is None)):
        log.warning("--memory %g changes nothing: no mesh is fused, and no edge of one is split", memory)
    place = Place(**place_of(device, devices, scheduler), folder=folder)
    settings_text = ", ".join([preset, *settings])
    with (one_run(folder) if folder else nullcontext(), resumable(folder, len(names or found.views)),
          shown_progress(quiet) as progress, one_run(report) if report else nullcontext(),
          _report(report, found, settings_text, place, call.obj, pictures) as page, noted(page and page.note)):
        depths = None
        if mesh is None:
            depths = together(given, align, _digests(given))
            depths = depths if folder is not None else loaded(depths)

        def choose(views: list[View], depths: Sequence[Any], config: Config) -> Config:
            """The settings that the time allows, once cameras and depth maps are there."""
            if time_per_view is not None or time_budget is not None:
                decided = {"effects__cameras": config.effects.cameras}
                config = config_in_time(views, depths, names, place.device, time_per_view, time_budget,
                                        lambda config: apply_settings(config, settings, **more, **decided), progress)
            if memory is not None and output is not None and not kept:
                some = [k for k, view in enumerate(views) if names is None or view.name in names]
                check_fusion([views[k] for k in some], [depths[k] for k in some], config.fusion, memory)
            if overwrite and folder is not None:
                claim_names(folder, stems, overwrite)
            log_memory(views, config, place.device, output is not None and not kept, memory, kept)
            return config

        done = refine_scene(
            found.views, mesh and to_surface(mesh), depths, config, names=names, place=place, choose=choose,
            making=MeshOptions(_made_as(output, kept, keep_mesh), subdivide, memory_mb=memory,
                               note=page and page.detail),
            progress=progress, on_view=page and _Pictures(page, cameras))
        if page is not None and done.cameras is not None:
            page.note(str(done.cameras))
        if output is not None:
            write_mesh(output, done.mesh)
            trim()
            if page is not None:
                with stage(progress, "show the mesh", 1) as showing:
                    _show_mesh(page, done, mesh, place.device)
                    showing.advance(1)
        if save_depth is not None:
            _save_cameras(save_depth, as_given, done.results)
        _log_results(done.results, output, save_depth, report)
        if folder is not None and save_depth is None:
            remove_run(folder)


def _made_as(output: Path | None, kept: bool, keep_mesh: bool) -> str | None:
    """What comes of the depth maps, as MeshOptions.output."""
    if output is None:
        return None
    if not kept:
        return "tsdf"
    return "displace" if keep_mesh else "mesh"


def _digests(given):
    """What planning the run needs of its files."""
    for view, depth in zip(given.scene.views, given.depths):
        yield partial(view_digest, view)
        yield partial(getattr, depth, "digest", None)


def _save_cameras(folder: Path, views, results) -> None:
    """Next to the depth maps the cameras that they belong to, where these were refined: not those of the scene's
    `views`."""
    pairs = joined(views, results)
    if any(result.camera is not views[place].camera for place, result in pairs):
        log.info("the refined cameras: %s", camera_file.write(
            folder, [replace(views[place], camera=result.camera, mask=None) for place, result in pairs]))


def _check_places(scene, given, mesh, depth_dir, photos, output, save_depth, report, overwrite: bool) -> None:
    """Refuse to write where something is read, and over what pagas_cl has not written."""
    outputs = {"--output": output, "--save-depth": save_depth, "--report": report,
               "the cameras in --save-depth": save_depth and save_depth / camera_file.NAME}
    inputs = {"SCENE": scene, "--mesh": mesh, "the mesh of SCENE": given.mesh if mesh is None else None,
              "--depth-dir": depth_dir, "--photos": photos, **scene_inputs(given.scene, given.depths)}
    check_outputs(outputs, inputs, overwrite)
    check_writable("--output", output and output.parent)
    check_writable("--save-depth", save_depth)


def _check_request(mesh, depth_dir, output, save_depth, report, keep_mesh: bool, subdivide, fuse: bool,
                   outside: bool) -> None:
    """Refuse what cannot end well before any work is done."""
    if mesh is not None:
        check_source(mesh, depth_dir, "where the refinement starts", outside)
    if output is None and save_depth is None and report is None:
        start = "" if mesh or depth_dir else "; and, where SCENE holds no surface itself, either --mesh or --depth-dir"
        raise InputError(f"nothing to write: give --output, --save-depth or --report{start}")
    if depth_dir is not None and not depth_dir.is_dir():
        raise InputError(f"--depth-dir {str(depth_dir)!r} is no folder")
    if output is not None:
        check_mesh_path(output)
    for name, folder in (("--save-depth", save_depth), ("--report", report)):
        if folder is not None and folder.exists() and not folder.is_dir():
            raise InputError(f"{name} {str(folder)!r} is a file, expected a folder")
    check_subdivide(subdivide)
    if keep_mesh and mesh is None:
        raise InputError("--keep-mesh needs --mesh: it moves that mesh's vertices")
    if keep_mesh and fuse:
        raise InputError("--keep-mesh and --fuse do not go together: give one of them")
    if subdivide is not None and (mesh is None or fuse):
        raise InputError("--subdivide needs --mesh without --fuse: a fused mesh has the voxel's fineness "
                         "(--set fusion.voxel=...)")


class _Pictures:
    """Puts a view's pictures on the page as soon as it is done, so that an interrupted run has them; `given`: cameras
    by name, before they were refined."""

    def __init__(self, page: Report, given: dict[str, Camera]):
        self._page, self._given = page, given

    def __call__(self, view: View, initial: np.ndarray, result: DepthResult) -> None:
        report = result.report
        remarks = ["compared with the photos: " + ", ".join(report["contexts"])] if report.get("contexts") else []
        details = []
        for on, what in ((True, "effects simulated"), (False, "effects not needed")):
            effects = [str(Decision(**fields)) for fields in report.get("effects", ()) if fields["on"] == on]
            details += [f"{what}: " + "; ".join(effects)] if effects else []
        figures = {"seconds": round(report["seconds"], 2)} if "seconds" in report else {}
        self._page.add(view, initial, result.depth, parallax=result.parallax, confidence=result.confidence,
                       counts={**result.counts, **figures}, remarks=remarks, details=details,
                       reason=result.reason, given=self._given[view.name])


def _show_mesh(page: Report, done: Refined, mesh: Path | None, device: Any) -> None:
    """Put the given and the made mesh on the page, seen from the view of which most was refined."""
    before, after = mesh and to_surface(mesh), to_surface(done.mesh)
    place, _ = max(joined(done.views, done.results), key=lambda pair: pair[1].counts["refined"])
    view = done.views[place]
    depths = before and [next(each_depth(surface, [view.camera], comparison_device(device)))
                         for surface in (before, after)]
    page.add_mesh(before, after, view=view, depths=depths)


def _report(folder, found, settings: str, place, command_line: str, pictures):
    """The Report to fill, or a context of None where no folder is given."""
    if folder is None:
        return nullcontext()
    where = place.executor or (place.device.info if isinstance(place.device, Device) else place.device)
    return Report(folder, "pagas-cl refine", pictures=pictures, began=time.monotonic(),
                  facts=[("scene", f"{found.source}, {len(found.views)} views")], particulars=[
                      ("command", command_line or ""), ("settings", settings), ("version", f"pagas_cl {__version__}"),
                      ("device", str(where))])


def _log_results(results, output, save_depth, report) -> None:
    """Say what came out; an error where views were left out, though what was made without them stays."""
    total = Counter()
    for result in results:
        total.update(result.counts)
    log.debug("pixels: %s", ", ".join(f"{number:,} {name}" for name, number in total.items()))
    log.info("%s", sentence([result.counts for result in results], [result.reason for result in results]))
    if output is not None:
        log.info("the refined mesh: %s", output)
    if save_depth is not None:
        log.info("the refined depth maps: %s", save_depth)
    if report is not None:
        log.info("pictures and figures, to open in a browser: %s", report / "index.html")
    failed = [(r.name, r.report["failed"]) for r in results if "failed" in r.report]
    if failed:
        names = ", ".join(name for name, _ in failed[:10]) + (", ..." if len(failed) > 10 else "")
        raise PagasError(f"{len(failed)} of {len(results)} views failed and were left out: {names} ({failed[0][1]}); "
                         "the rest is done, start the same command again for these")
