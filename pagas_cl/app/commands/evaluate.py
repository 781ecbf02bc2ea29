"""`pagas-cl evaluate`: errors of a mesh, a point cloud or depth maps, in the figures that benchmarks use."""

import math
import sys
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import typer

from pagas_cl.app.commands import _options as options
from pagas_cl.app.commands._given import load_scene
from pagas_cl.app.commands._outputs import check_outputs, scene_inputs
from pagas_cl.app.commands._process import typed
from pagas_cl.app.evaluate import clouds
from pagas_cl.app.evaluate.depth import compare_depth, depth_per_parallax
from pagas_cl.app.report.writer import agreement
from pagas_cl.config import Context
from pagas_cl.errors import InputError, log, plain
from pagas_cl.jobs.finished import users_of
from pagas_cl.method.surface.agree import comparison_device
from pagas_cl.method.surface.raster import each_depth
from pagas_cl.method.view.prediction import PATCH, compare_predictions
from pagas_cl.scene.check.cameras import check_seen
from pagas_cl.scene.choice import ContextChooser
from pagas_cl.scene.depth.source import of_photo
from pagas_cl.scene.depthmap import check_unit, find_depths
from pagas_cl.scene.meshes.kinds import to_surface
from pagas_cl.scene.names import file_stems
from pagas_cl.scene.own_files import write_json
from pagas_cl.scene.view import View

_PREDICTED = "correlation of held-out photos"


def command(
    result: Path = typer.Argument(..., help="A mesh, a point cloud, or a folder of depth maps."),
    truth: Path = typer.Argument(None, help="The true one, of the same kind; may be left out with --held-out."),
    scene: Path = typer.Option(None, "--scene", help="With depth maps or --held-out: the scene's folder."),
    held_out: list[str] = typer.Option([], "--held-out", help="A view whose photo is predicted through RESULT."),
    before: Path = typer.Option(None, "--before", help="With --held-out: a mesh or depth maps to compare with."),
    depth_scale: float = typer.Option(None, "--depth-scale", parser=options.above_zero, metavar="NUMBER",
                                      help="Number for one scene unit in depth files: in PNGs, where there are any."),
    spacing: float = typer.Option(None, "--spacing", parser=options.above_zero, metavar="LENGTH",
                                  help="Sample meshes, and thin the result, to this distance, and measure from point "
                                  "to point, as benchmarks do."),
    threshold: list[float] = typer.Option([], "--threshold", parser=options.above_zero, metavar="LENGTH",
                                          help="Distance for precision, recall and F-score."),
    max_distance: float = typer.Option(None, "--max-distance", parser=options.above_zero, metavar="LENGTH",
                                       help="Chamfer: leave out larger distances."),
    visible: Path = typer.Option(None, "--visible", help="Chamfer: DTU's ObsMask<scan>_10.mat."),
    ground: Path = typer.Option(None, "--ground", help="Chamfer: DTU's Plane<scan>.mat."),
    photos: Path = options.PHOTOS,
    output: Path = typer.Option(None, "--json", help="Write the figures to this file too."),
    overwrite: bool = options.OVERWRITE,
    quiet: bool = options.QUIET,
):
    """Compare with the truth: depth and normal errors, Chamfer distance, F-score; or predict held-out photos.

    DTU's figures: --spacing 0.2 --max-distance 20 --visible ObsMask24_10.mat --ground Plane24.mat.
    Tanks and Temples': --threshold T --spacing T/2.
    """
    if not result.exists():
        raise InputError(f"there is no file or folder {str(result)!r}")
    views = None if scene is None else load_scene(scene, None, False, photos)
    check_outputs([("--json", output)], [], {
        "RESULT": result, "TRUTH": truth, "--scene": scene, "--photos": photos, "--before": before,
        "--visible": visible, "--ground": ground, **(scene_inputs(views) if views else {})}, overwrite)
    if views is None and (held_out or result.is_dir()):
        raise InputError(f"--scene is missing, the folder of photos and cameras that {str(result)!r} belongs to")
    if before is not None and not held_out:
        raise InputError("--before is compared by photos that took no part: name them with --held-out")
    if truth is None and not held_out:
        raise InputError(f"nothing to compare {str(result)!r} with: give the truth, of the same kind, as the second "
                         "argument, or --held-out VIEW")
    if views is not None and not (held_out or result.is_dir()):
        raise InputError(f"--scene goes with a folder of depth maps or --held-out, and {str(result)!r} is a file")
    between = {"--spacing": spacing, "--threshold": threshold or None, "--max-distance": max_distance,
               "--visible": visible, "--ground": ground}
    unused = [name for name, value in between.items() if value is not None and (truth is None or result.is_dir())]
    if unused:
        raise InputError(f"{unused[0]} goes with a mesh or a point cloud and its truth, between which distances are "
                         "measured: leave it out, or give these")
    figures = {}
    if truth is not None and result.is_dir():
        figures = _depth_errors(views, result, truth, depth_scale)
    elif truth is not None:
        figures = _cloud_figures(result, truth, spacing, threshold, max_distance, visible, ground)
    proven = False
    if held_out:
        judges = [views.views[place] for place in dict.fromkeys(map(views.index, held_out))]
        judged = [view for view in views.views if view not in judges]
        proven = not _took_part(judges, judged, result) and before is not None
        figures[_PREDICTED] = _photo_predictions(views, judged, judges, result, before, depth_scale)
    for group, rows in figures.items():
        sys.stdout.write(_table(group, rows))
    found: dict[str, Any] = {"figures": figures}
    if proven:
        found["sentence"] = agreement([(1 - row["median_before"], 1 - row["median"])
                                       for row in figures[_PREDICTED].values()], "photo pair")
        sys.stdout.write(found["sentence"] + "\n")
    if output is not None:
        write_json(output, "evaluate", found)


def _depth_errors(scene, folder, truth_folder, scale) -> dict[str, dict]:
    """Title of a view -> figures; parallax is that against all other views."""
    rows = {}
    for view, (depth, truth) in _depths_of(scene.views, [folder, truth_folder], scale):
        others = [other.camera for other in scene.views if other is not view]
        title = f"{view.name}: depth error (scene units, pixels of parallax) and normal error (degrees)"
        rows[title] = asdict(compare_depth(depth, truth, view.camera, mask=view.load_mask(),
                                           parallax=depth_per_parallax(truth, view.camera, others)))
    if not rows:
        raise InputError(f"no view of {scene.source or 'the scene'} has a depth map in both {str(folder)!r} and "
                         f"{str(truth_folder)!r}, expected for instance "
                         f"{file_stems([view.name for view in scene.views])[0]}.npz in each")
    return rows


def _photo_predictions(scene, views, kept_out, result, before, scale) -> dict[str, dict]:
    """"<view> from <held-out view>" -> median correlation and pixels; of a mesh or maps `before` on the same."""
    from pagas_cl.method.cameras.judge import fitted_poses

    rows, left_out, settings = {}, 0, Context(min_angle=0.0)
    most = f"{settings.max_angle:g} degrees"
    for view, depths in _depths_of(views, [result] if before is None else [result, before], scale, kept_out):
        for other in kept_out:
            # one that could not have been a context view has the other side of a thing before it
            usable = ContextChooser([view.camera, other.camera], [depths[0], None], settings).choose(0).indices
            found = compare_predictions(view, depths, fitted_poses(other, view, depths)) if usable else []
            if not found or not found[0].pixels:
                left_out += 1
                continue
            after, *first = found
            row = rows[f"{view.name} from {other.name}"] = {"median": after.median, "pixels": after.pixels}
            if first:
                row["median_before"] = first[0].median
    if not rows:
        raise InputError(f"no photo can be predicted: no view of {scene.source or 'the scene'} with a depth in "
                         f"{str(result)!r} has a textured patch of {PATCH} x {PATCH} pixels that a held-out view, at "
                         f"most {most} to its side, sees too: hold out others, or take larger photos of a small thing")
    if left_out:
        log.info("left out are %d of %d pairs of a view and a held-out photo: they see too little of the same, or look "
                 "from more than %s to the side", left_out, left_out + len(rows), most)
    return rows


def _took_part(judges, judged, result) -> bool:
    """Whether any of the `judges` took part in the depth maps of the views `judged`, where `result` is the folder of a
    run that says so; each is warned of. Maps of judges, which an earlier run may have left there, do not matter."""
    users, names = users_of(result) if result.is_dir() else {}, {view.name for view in judged}
    numbers = {judge.name: len(names.intersection(users.get(judge.name, ()))) for judge in judges}
    for name, number in numbers.items():
        if number:
            log.warning("%s is no held-out photo: it took part in the refinement of %d of the views in %s, so that the "
                        "figures flatter; refine with --hold-out %s to have it judge", name, number, result,
                        typed([name]))
    return any(numbers.values())


def _depths_of(views, shapes, scale, others=()) -> Iterator[tuple[View, list[np.ndarray]]]:
    """The views that have a depth in all `shapes`, folders of depth maps or meshes, each with these, one at a time.

    `scale`: number for one scene unit, of PNGs alone where there are any, since depth maps of pagas_cl say theirs.
    """
    names, cameras = [view.name for view in views], [view.camera for view in views]
    files = [find_depths(shape, names, [view.name for view in others]) if shape.is_dir() else None for shape in shapes]
    has_png = any(file and file.suffix.lower() == ".png" for of_shape in files for file in of_shape or ())

    def depth(file: Path | None, view: View) -> np.ndarray | None:
        if file is None:
            return None
        own = None if has_png and file.suffix.lower() != ".png" else scale
        check_unit(file, own)
        return of_photo(file, view.image, view.camera, 1.0 if own is None else own).load()

    def drawn(mesh: Path) -> Iterator[np.ndarray]:
        surface = to_surface(mesh)
        check_seen(surface, cameras)
        return each_depth(surface, cameras, comparison_device(None))

    for view, *depths in zip(views, *(drawn(shape) if of_shape is None else map(depth, of_shape, views)
                                      for shape, of_shape in zip(shapes, files))):
        if all(found is not None for found in depths):
            yield view, depths


def _cloud_figures(result, truth, spacing, thresholds, max_distance, visible, ground):
    shapes, surfaces = [clouds.read_shape(path) for path in (result, truth)], (None, None)
    if spacing is None:         # with one, distances are those between points that benchmarks define
        spacing = clouds.extent(shapes[1][0]) / 1000
        surfaces = tuple(None if shape[1] is None else shape for shape in shapes)
    sampled = [points if faces is None else clouds.sample_surface(points, faces, spacing) for points, faces in shapes]
    # points of one surface are never those of another
    floor = max((clouds.floor_of(cloud) for cloud, surface in zip(sampled, surfaces) if surface is None), default=0.0)
    to = ("to the surface" if not floor else "to points" if surfaces == (None, None)
          else "to the surface of one, to the points of the other")
    below = f"; below about {floor:.2g} they measure the spacing of the points and no error" if floor else ""
    distances = clouds.chamfer(
        *sampled, surfaces=surfaces, downsample=spacing,
        max_distance=math.inf if max_distance is None else max_distance,
        visible=None if visible is None else clouds.load_visible(visible),
        ground=None if ground is None else clouds.load_ground(ground))
    title = f"Chamfer distance, scene units ({to}; points every {spacing:.4g}){below}"
    figures = {title: {"": asdict(distances)}}
    if thresholds:
        figures["share of points within a distance"] = {
            f"{distance:g}": asdict(clouds.f_score(*sampled, distance, downsample=spacing, surfaces=surfaces))
            for distance in thresholds}
    return figures


def _table(title, rows):
    columns = list(dict.fromkeys(name for row in rows.values() for name in row))
    head = max(len(name) for name in [*rows, ""])
    widths = {name: max(len(name), 10) for name in columns}
    lines = [title, " " * head + "".join(f"  {name:>{widths[name]}}" for name in columns)]
    for name, row in rows.items():
        cells = ("" if x is None else f"{x:d}" if isinstance(x, int) else f"{x:.5g}" for x in map(row.get, columns))
        lines.append(f"{name:<{head}}" + "".join(f"  {cell:>{widths[c]}}" for cell, c in zip(cells, columns)))
    return "\n".join(map(plain, [*lines, "", ""]))
