"""A synthetic scene refined and judged against its exact truth: what `pagas-cl demo` runs."""

import time
from dataclasses import dataclass
from pathlib import Path

from pagas_cl.app.evaluate import DepthReport, compare_depth, compare_predictions
from pagas_cl.app.report import Report
from pagas_cl.app.synthetic.layout import half_sizes
from pagas_cl.app.synthetic.mesh import clustered, solid_mesh
from pagas_cl.app.synthetic.scene import SyntheticScene, relief_scene, write_scene
from pagas_cl.config.presets import settings_of
from pagas_cl.config.version import __version__
from pagas_cl.errors import log
from pagas_cl.method.surface.agree import comparison_device
from pagas_cl.method.surface.fuse import fuse
from pagas_cl.method.surface.raster import each_depth
from pagas_cl.progress import Progress, Reporter, progress_of, reported
from pagas_cl.scene.mesh import Surface
from pagas_cl.scene.meshes.files import write_mesh

HARD = {"spacing": 18.0, "base": 15.0, "detail": 1.0, "steps": 4, "bar": 5.0}
"""Settings of `Relief` of a scene whose coarse mesh is far off."""
_CLUSTER = 6.0    # pixels within which vertices of that mesh are drawn together;
_FINE = 0.5       # and between those of the true mesh that it is made of


@dataclass(frozen=True, eq=False)
class DemoResult:
    """What came out."""

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


def run_demo(folder, *, width=288, height=216, contexts=4, bar: float = 0.0, hard: bool = False,
             preset: str | None = None, device=None, progress: Reporter = None) -> DemoResult:
    """Make a relief scene, refine the depth of each of its views, compare with the truth, fuse a mesh.

    `folder` gets `scene/` (photos, cameras, coarse mesh, depth maps: input for the other commands), `report/` with the
    page and the pictures, `mesh_refined.ply`. `contexts`: views besides the target and one held-out view. `bar`: width
    of a bar in front, pixels; `hard`: a start that is far off, as far_start has it (needs Open3D). `preset`,
    `device` and `progress` as in refine_depth.
    """
    folder, shown, began = Path(folder), progress_of(progress), time.monotonic()
    settings = {**(HARD if hard else {}), **({"bar": bar} if bar else {})}
    synthetic = relief_scene(width, height, contexts, held_out=1, **settings)
    for number in reported(shown, "make the scene", range(len(synthetic.cameras))):
        synthetic.image(number)
    if hard:
        coarse, initial = far_start(synthetic, device)
    else:
        coarse, initial = Surface(*synthetic.initial_mesh()), [*map(synthetic.initial_depth, synthetic.cameras)]
    write_scene(synthetic, folder / "scene", coarse, initial)
    start = time.perf_counter()
    results = _refined(synthetic, initial, settings_of(preset, None), device, shown)
    seconds = time.perf_counter() - start
    depths = [result.depth for result in results]
    initial = initial[:len(depths)]
    relief = synthetic.relief
    notes = [f"A synthetic relief, {relief.width} x {relief.height} pixels, {len(synthetic.views)} views "
             f"{relief.spacing:g} degrees apart; the initial depth is of " + (
                 "a mesh whose vertices were clustered and smoothed." if hard else "the same without the fine detail."),
             f"One pixel of parallax is {relief.parallax:.3g} scene units."]
    made = [("version", f"pagas_cl {__version__}"), ("device", str(getattr(device, "info", device or "the default")))]
    with Report(folder / "report", "pagas-cl demo", notes, particulars=made, began=began) as report:
        for view, old, result in zip(synthetic.views, initial, results):
            report.add(view, old, result)
        mesh = _mesh(synthetic, coarse, (initial, depths), folder, shown, report, device)
    target, other = synthetic.views[0], synthetic.held_out[0]
    predicted = compare_predictions(target, [initial[0], depths[0]], other, synthetic.true_depth(other.camera))
    return DemoResult(_errors(synthetic, initial), _errors(synthetic, depths), tuple(p.median for p in predicted),
                      folder / "report" / "index.html", mesh, seconds)


def far_start(synthetic: SyntheticScene, device) -> tuple[Surface, list]:
    """A coarse mesh that is far off, the true one's vertices drawn together and smoothed, and its depth in all cameras:
    thin things are gone, edges rounded. Needs Open3D."""
    footprint = synthetic.relief.footprint
    fine = solid_mesh(synthetic.true_solid, _FINE * footprint, half_sizes(synthetic.relief))
    coarse = Surface(*clustered(*fine, _CLUSTER * footprint))
    return coarse, list(each_depth(coarse, synthetic.cameras, comparison_device(device)))


def _refined(synthetic: SyntheticScene, initial, config, device, progress: Progress):
    from pagas_cl.method.view.one_view import refine_depth

    results = []
    for place, view in enumerate(reported(progress, "refine", synthetic.views)):
        others = [other for other in synthetic.views if other is not view]
        results.append(refine_depth(view, others, initial[place], config=config, device=device))
    return results


def _errors(synthetic, depths):
    return {view.name: compare_depth(depth, synthetic.true_depth(view.camera), view.camera, mask=view.load_mask(),
                                     parallax=synthetic.relief.parallax,
                                     true_normals=synthetic.true_normals(view.camera))
            for view, depth in zip(synthetic.views, depths)}


def _mesh(synthetic, coarse, depths, folder, progress: Progress, report, device):
    try:
        import open3d  # noqa: F401
    except ImportError as error:  # absent, or one of the system libraries that it needs is
        log.warning('no mesh is made, since Open3D cannot be loaded (%s): pip install "pagas-cl[mesh]"', error)
        return None

    initial, refined = depths
    surface = fuse(synthetic.views, refined, progress=progress)
    path = folder / "mesh_refined.ply"
    write_mesh(path, surface)
    view = synthetic.views[0]
    made = next(each_depth(surface, [view.camera], comparison_device(device)))
    report.add_mesh((coarse.vertices, coarse.faces), surface, view=view, depths=(initial[0], made))
    log.debug("%s: %d vertices, %d triangles", path, len(surface.vertices), len(surface.faces))
    return path
