"""`pagas-cl demo`: a small scene with known geometry, refined on whatever device there is."""

import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import typer

from pagas_cl.app.commands import _options as options
from pagas_cl.app.commands._outputs import check_writable
from pagas_cl.app.commands._process import opened_device, shown_progress
from pagas_cl.app.demo_scene import CLUSTERED, FAR, DemoScene, Look, make_scene
from pagas_cl.app.evaluate.depth import DepthReport, compare_depth
from pagas_cl.app.report import Report
from pagas_cl.config.presets import settings_of
from pagas_cl.config.version import __version__
from pagas_cl.errors import InputError, log
from pagas_cl.jobs.work_folder import one_run
from pagas_cl.method.surface.agree import comparison_device
from pagas_cl.method.surface.fuse import fuse
from pagas_cl.method.surface.raster import each_depth
from pagas_cl.method.view.one_view import refine_depth
from pagas_cl.method.view.prediction import compare_predictions
from pagas_cl.progress import Progress, Reporter, progress_of, reported
from pagas_cl.scene.meshes.files import write_mesh

_USUAL, _HARD = (288, 216), (388, 290)      # width and height of the photos


@dataclass(frozen=True, eq=False)
class DemoResult:
    before: dict[str, DepthReport]      # errors of each view's initial depth
    after: dict[str, DepthReport]       # and of its refined depth
    prediction: tuple[float, float]     # median correlation of 7x7 patches with a photo that took no part, the same
    page: Path                          # of the report
    mesh: Path | None                   # fused; None without Open3D
    seconds: float                      # spent on refining, the device's compiler included

    def table(self) -> str:
        head = (f"{'':<12}{'mean depth error':>24}{'median':>20}{'normals':>20}{'near edges':>20}\n"
                f"{'view':<12}{'(pixels of parallax)':>24}{'':>20}{'(degrees)':>20}{'(px of parallax)':>20}\n")
        rows = []
        for name in self.before:
            a, b = ((r.smooth.mean_parallax, r.smooth.median_parallax, r.smooth.normal_mean, r.edges.mean_parallax)
                    for r in (self.before[name], self.after[name]))
            mean, median, normals, edges = (f"{x:.{n}f} -> {y:.{n}f}" for x, y, n in zip(a, b, (3, 3, 1, 3)))
            rows.append(f"{name:<12}{mean:>24}{median:>20}{normals:>20}{edges:>20}\n")
        old, new = self.prediction
        return head + "".join(rows) + f"correlation with the held-out photo: {old:.4f} -> {new:.4f}\n"


def run_demo(folder, *, width: int | None = None, contexts: int | None = None, bar: float = 0.0, hard: bool = False,
             preset: str | None = None, device=None, progress: Reporter = None) -> DemoResult:
    """Make a relief scene, refine the depth of each of its views, compare with the truth, fuse a mesh.

    `folder` gets `scene/` (photos, cameras, coarse mesh, depth maps: input for the other commands), `report/` with the
    page and the pictures, `mesh_refined.ply`. `width` of the photos, which are three quarters as high: 288; `contexts`:
    views besides the target and one held-out view, 4. `bar`: width of a bar in front, pixels; `hard`: a start that is
    far off (needs Open3D), with photos of 388 x 290 and 5 context views. The others as in refine_depth.
    """
    width, height = (_HARD if hard else _USUAL) if width is None else (width, round(0.75 * width))
    contexts = (5 if hard else 4) if contexts is None else contexts
    folder, shown, began = Path(folder), progress_of(progress), time.monotonic()
    look = FAR if hard else Look()
    made = make_scene(width, height, contexts, comparison_device(device), replace(look, bar=bar or look.bar),
                      CLUSTERED if hard else 0.0)
    made.write(folder / "scene")
    config, views, results, start = settings_of(preset, None), made.views[:-1], [], time.perf_counter()
    for place, view in enumerate(reported(shown, "refine", views)):
        others = [other for other in views if other is not view]
        results.append(refine_depth(view, others, made.initial[place], config=config, device=device))
    seconds = time.perf_counter() - start
    depths = [result.depth for result in results]
    notes = [f"A made relief, {width} x {height} pixels, {len(results)} views; the initial depth is of " + (
                 "a mesh whose vertices were clustered and smoothed." if hard else "the same without the fine detail."),
             f"One pixel of parallax is {made.parallax:.3g} scene units."]
    about = [("version", f"pagas_cl {__version__}"), ("device", str(getattr(device, "info", device or "the default")))]
    with Report(folder / "report", "pagas-cl demo", notes, particulars=about, began=began) as report:
        for view, old, result in zip(made.views, made.initial, results):
            report.add(view, old, result)
        mesh = _mesh(made, depths, folder, shown, report, device)
    predicted = compare_predictions(made.views[0], [made.initial[0], depths[0]], made.views[-1], made.true[-1])
    return DemoResult(_errors(made, made.initial[:-1]), _errors(made, depths), tuple(p.median for p in predicted),
                      folder / "report" / "index.html", mesh, seconds)


def _errors(made: DemoScene, depths):
    return {view.name: compare_depth(depth, true, view.camera, parallax=made.parallax)
            for view, depth, true in zip(made.views, depths, made.true)}


def _mesh(made: DemoScene, depths, folder, progress: Progress, report, device):
    try:
        import open3d  # noqa: F401
    except ImportError as error:  # absent, or one of the system libraries that it needs is
        log.warning('no mesh is made, since Open3D cannot be loaded (%s): pip install "pagas-cl[mesh]"', error)
        return None

    surface = fuse(made.views[:-1], depths, progress=progress)
    path = folder / "mesh_refined.ply"
    write_mesh(path, surface)
    view = made.views[0]
    fused = next(each_depth(surface, [view.camera], comparison_device(device)))
    report.add_mesh((made.coarse.vertices, made.coarse.faces), surface, view=view, depths=(made.initial[0], fused))
    log.debug("%s: %d vertices, %d triangles", path, len(surface.vertices), len(surface.faces))
    return path


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
