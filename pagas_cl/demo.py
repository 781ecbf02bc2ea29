"""A made scene refined and judged against its exact truth: what `pagas-cl demo` runs."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass
from pathlib import Path

from pagas_cl.evaluate import DepthReport, compare_depth, compare_predictions
from pagas_cl.made import MadeScene, relief_scene
from pagas_cl.progress import ViewProgress

_log = logging.getLogger("pagas_cl")


@dataclass(frozen=True, eq=False)
class DemoResult:
    """What came out.

    Attributes
    ----------
    before, after : dict of str to DepthReport
        Errors of each view's initial and refined depth.
    prediction : tuple of two floats
        Median correlation of 7x7 patches of the target with a photo that took no part, before and after.
    page, mesh : Path or None
        The report's page; the fused mesh (None without Open3D).
    seconds : float
        Spent on refining, the device's compiler included.
    """

    before: dict[str, DepthReport]
    after: dict[str, DepthReport]
    prediction: tuple[float, float]
    page: Path
    mesh: Path | None
    seconds: float

    def table(self) -> str:
        """The errors as text."""
        head = (f"{'':<12}{'mean depth error':>24}{'median':>20}{'normals':>20}{'near edges':>20}\n"
                f"{'view':<12}{'(pixels of parallax)':>24}{'':>20}{'(degrees)':>20}{'(px of parallax)':>20}\n")
        rows = []
        for name, old in self.before.items():
            new = self.after[name]
            pairs = ((old.smooth.mean_parallax, new.smooth.mean_parallax),
                     (old.smooth.median_parallax, new.smooth.median_parallax),
                     (old.smooth.normal_mean, new.smooth.normal_mean),
                     (old.edges.mean_parallax, new.edges.mean_parallax))
            cells = [f"{a:.3f} -> {b:.3f}" for a, b in pairs]
            cells[2] = f"{pairs[2][0]:.1f} -> {pairs[2][1]:.1f}"
            rows.append(f"{name:<12}{cells[0]:>24}" + "".join(f"{cell:>20}" for cell in cells[1:]) + "\n")
        old, new = self.prediction
        return head + "".join(rows) + f"correlation with the held-out photo: {old:.4f} -> {new:.4f}\n"


def run_demo(folder, *, width=288, height=216, contexts=4, preset="balanced", config=None, device=None,
             progress=None, **settings) -> DemoResult:
    """Make a relief scene, refine the depth of each of its views, compare with the truth, fuse a mesh.

    Parameters
    ----------
    folder : path
        Gets `scene/` (photos, cameras, coarse mesh, depth maps: input for the other commands), `report/` with the
        page and the pictures, `mesh_refined.ply`.
    width, height, contexts : int
        Size of the photos; number of views besides the target and one held-out view.
    preset, config, device, progress
        As in `refine_depth`.
    settings
        Further fields of `made.Relief`.
    """
    from pagas_cl.made.disk import write_scene
    from pagas_cl.report import Report

    folder, progress = Path(folder), progress or (lambda stage, done, total: None)
    made = relief_scene(width, height, contexts, held_out=1, **settings)
    for number in range(len(made.cameras)):
        progress("make the scene", number, len(made.cameras))
        made.image(number)
    write_scene(made, folder / "scene")
    progress("make the scene", len(made.cameras), len(made.cameras))
    start = time.perf_counter()
    results = _refined(made, preset, config, device, progress)
    seconds = time.perf_counter() - start
    depths = [result.depth for result in results]
    initial = [made.initial_depth(view.camera) for view in made.views]
    with Report(folder / "report", "pagas-cl demo", _notes(made, seconds)) as report:
        for view, old, result in zip(made.views, initial, results):
            report.add(view, old, result.depth, contexts=[v.camera for v in made.views if v is not view],
                       confidence=result.confidence, counts=result.counts)
    target, other = made.views[0], made.held_out[0]
    predicted = compare_predictions(target, [initial[0], depths[0]], other, made.true_depth(other.camera))
    return DemoResult(_errors(made, initial), _errors(made, depths), tuple(p.median for p in predicted),
                      folder / "report" / "index.html", _mesh(made, depths, folder, progress), seconds)


def _refined(made: MadeScene, preset, config, device, progress):
    from pagas_cl.refine import refine_depth

    results, told = [], ViewProgress(progress, len(made.views))
    for number, view in enumerate(made.views):
        told.at(number)
        others = [other for other in made.views if other is not view]
        results.append(refine_depth(view, others, made.initial_depth(view.camera), preset=preset, config=config,
                                    device=device, progress=told.inside(number)))
    told.at(len(made.views))
    return results


def _errors(made, depths):
    return {view.name: compare_depth(depth, made.true_depth(view.camera), view.camera, mask=view.load_mask(),
                                     parallax=made.relief.parallax, true_normals=made.true_normals(view.camera))
            for view, depth in zip(made.views, depths)}


def _mesh(made, depths, folder, progress):
    try:
        import open3d as o3d
    except ImportError as error:  # absent, or one of the system libraries that it needs is
        _log.warning('no mesh is made, since Open3D cannot be loaded (%s): pip install "pagas-cl[mesh]"', error)
        return None

    from pagas_cl.scene.mesh import from_surface
    from pagas_cl.surface.fuse import fuse

    surface = fuse(made.views, depths, progress=progress)
    path = folder / "mesh_refined.ply"
    o3d.io.write_triangle_mesh(str(path), from_surface(surface, o3d.geometry.TriangleMesh()))
    _log.info("%s: %d vertices, %d triangles", path, len(surface.vertices), len(surface.faces))
    return path


def _notes(made, seconds):
    relief = made.relief
    return [f"A made relief, {relief.width} x {relief.height} pixels, {len(made.views)} views {relief.spacing:g} "
            "degrees apart; the initial depth has the fine detail smoothed away.",
            f"One pixel of parallax is {relief.parallax:.3g} scene units.", f"Refined in {seconds:.1f} s."]
