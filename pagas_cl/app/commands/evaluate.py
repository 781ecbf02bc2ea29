"""`pagas-cl evaluate`: errors of a mesh, a point cloud or depth maps, in the figures that benchmarks use."""

import math
import sys
from dataclasses import asdict
from pathlib import Path

import typer

from pagas_cl.app.commands._options import DEPTH_SCALE, OVERWRITE, QUIET, above_zero
from pagas_cl.app.commands._outputs import check_outputs, scene_inputs
from pagas_cl.app.evaluate import chamfer, compare_depth, compare_predictions, depth_per_parallax, f_score
from pagas_cl.app.evaluate.clouds import extent, floor_of, load_ground, load_visible, read_shape, sample_surface
from pagas_cl.errors import InputError, log, plain
from pagas_cl.jobs.finished import users_of
from pagas_cl.scene.depthmap import find_depths, load_depth
from pagas_cl.scene.own_files import write_json
from pagas_cl.scene.readers import read_scene


def command(
    result: Path = typer.Argument(..., help="A mesh, a point cloud, or a folder of depth maps."),
    truth: Path = typer.Argument(None, help="The true one, of the same kind; may be left out with --held-out."),
    scene: Path = typer.Option(None, "--scene", help="With depth maps: the scene's folder."),
    held_out: list[str] = typer.Option([], "--held-out", help="With depth maps: a view whose photo is predicted."),
    before: Path = typer.Option(None, "--before", help="With --held-out: depth maps to compare with."),
    depth_scale: float = DEPTH_SCALE,
    spacing: float = typer.Option(None, "--spacing", parser=above_zero, metavar="LENGTH",
                                  help="Sample meshes, and thin the result, to this distance, and measure from point "
                                  "to point, as benchmarks do."),
    threshold: list[float] = typer.Option([], "--threshold", parser=above_zero, metavar="LENGTH",
                                          help="Distance for precision, recall and F-score."),
    max_distance: float = typer.Option(None, "--max-distance", parser=above_zero, metavar="LENGTH",
                                       help="Chamfer: leave out larger distances."),
    visible: Path = typer.Option(None, "--visible", help="Chamfer: DTU's ObsMask<scan>_10.mat."),
    ground: Path = typer.Option(None, "--ground", help="Chamfer: DTU's Plane<scan>.mat."),
    output: Path = typer.Option(None, "--json", help="Write the figures to this file too."),
    overwrite: bool = OVERWRITE,
    quiet: bool = QUIET,
):
    """Compare with the truth: depth and normal errors, Chamfer distance, F-score; or predict held-out photos.

    DTU's figures: --spacing 0.2 --max-distance 20 --visible ObsMask24_10.mat --ground Plane24.mat.
    Tanks and Temples': --threshold T --spacing T/2.
    """
    if not result.exists():
        raise InputError(f"there is no file or folder {str(result)!r}")
    views = None if scene is None else read_scene(scene)
    check_outputs([("--json", output)], [], {
        "RESULT": result, "TRUTH": truth, "--scene": scene, "--before": before, "--visible": visible,
        "--ground": ground, **(scene_inputs(views) if views else {})}, overwrite)
    if result.is_dir():
        figures = _depth_figures(result, truth, views, held_out, before, depth_scale)
    elif held_out or scene is not None or before is not None:
        raise InputError(f"--scene, --held-out and --before go with a folder of depth maps, and {str(result)!r} is a "
                         "file")
    else:
        figures = _cloud_figures(result, truth, spacing, threshold, max_distance, visible, ground)
    for group, rows in figures.items():
        sys.stdout.write(_table(group, rows))
    if output is not None:
        write_json(output, "evaluate", {"figures": figures})


def _depth_figures(folder, truth, scene, held_out, before, scale):
    if scene is None:
        raise InputError(f"{str(folder)!r} is a folder of depth maps: give the scene they belong to with --scene")
    if truth is None and not held_out:
        raise InputError("nothing to compare with: give a folder of true depth maps, or --held-out VIEW")
    figures = {}
    if truth is not None:
        for view, parts in _depth_errors(scene, folder, truth, scale).items():
            figures[f"{view}: depth error (scene units, pixels of parallax) and normal error (degrees)"] = parts
    if held_out:
        figures["correlation of held-out photos"] = _photo_predictions(scene, folder, held_out, before, scale)
    return figures


def _depth_errors(scene, folder, truth_folder, scale) -> dict[str, dict]:
    """View name -> figures; parallax is that against all other views."""
    rows = {}
    names = [view.name for view in scene.views]
    places = [find_depths(where, names) for where in (folder, truth_folder)]
    for view, *files in zip(scene.views, *places):
        depth, truth = (_depth(file, view, scale) for file in files)
        if depth is None or truth is None:
            continue
        others = [other.camera for other in scene.views if other is not view]
        rows[view.name] = asdict(compare_depth(depth, truth, view.camera, mask=view.load_mask(),
                                               parallax=depth_per_parallax(truth, view.camera, others)))
    if not rows:
        raise InputError(f"no view of {scene.source or 'the scene'} has a depth map in both {str(folder)!r} and "
                         f"{str(truth_folder)!r}; they are named <image stem>.npz")
    return rows


def _photo_predictions(scene, folder, held_out, before, scale) -> dict[str, dict]:
    """"<view> from <held-out view>" -> median correlation and pixels; with depth maps `before` on the same pixels."""
    from pagas_cl.method.cameras.judge import fitted_poses

    kept_out = [scene.views[scene.index(name)] for name in held_out]
    users, rows = users_of(folder), {}
    for view in kept_out:
        if view.name in users:
            log.warning("%s is no held-out photo: it took part in the refinement of %d of the views in %s, so that the "
                        "figures flatter; refine with --hold-out %s to have it judge", view.name,
                        len(users[view.name]), folder, view.name)
    names = [view.name for view in scene.views]
    places = [find_depths(where, names) for where in (folder, before) if where is not None]
    for view, *files in zip(scene.views, *places):
        if view in kept_out:
            continue
        depths = [_depth(file, view, scale) for file in files]
        if any(depth is None for depth in depths):
            continue
        for other in kept_out:
            after, *first = compare_predictions(view, depths, fitted_poses(other, view, depths))
            if not after.pixels:
                log.warning("%s: nothing of it is seen in %s", view.name, other.name)
                continue
            row = rows[f"{view.name} from {other.name}"] = {"median": after.median, "pixels": after.pixels}
            if first:
                row["median_before"] = first[0].median
    if not rows:
        raise InputError(f"no photo can be predicted: no view of {scene.source or 'the scene'} with a depth map in "
                         f"{str(folder)!r} sees what a held-out view sees")
    return rows


def _depth(path, view, scale):
    return None if path is None else load_depth(path, (view.camera.width, view.camera.height), scale=scale)


def _cloud_figures(result, truth, spacing, thresholds, max_distance, visible, ground):
    if truth is None:
        raise InputError("nothing to compare with: give the true mesh or point cloud as the second argument")
    shapes, surfaces = [read_shape(path) for path in (result, truth)], (None, None)
    if spacing is None:         # with one, distances are those between points that benchmarks define
        spacing = extent(shapes[1][0]) / 1000
        surfaces = tuple(None if shape[1] is None else shape for shape in shapes)
    clouds = [points if faces is None else sample_surface(points, faces, spacing) for points, faces in shapes]
    to, floor = _floor_of(clouds, surfaces)
    distances = chamfer(
        *clouds, surfaces=surfaces, downsample=spacing, max_distance=math.inf if max_distance is None else max_distance,
        visible=None if visible is None else load_visible(visible),
        ground=None if ground is None else load_ground(ground))
    title = f"Chamfer distance, scene units ({to}; points every {spacing:.4g}){floor}"
    figures = {title: {"": asdict(distances)}}
    if thresholds:
        figures["share of points within a distance"] = {
            f"{distance:g}": asdict(f_score(*clouds, distance, downsample=spacing, surfaces=surfaces))
            for distance in thresholds}
    return figures


def _floor_of(clouds, surfaces) -> tuple[str, str]:
    """What distances are to, and below what they say nothing: points of one surface are never those of another."""
    floor = max((floor_of(cloud) for cloud, surface in zip(clouds, surfaces) if surface is None), default=0.0)
    if not floor:
        return "to the surface", ""
    to = "to points" if surfaces == (None, None) else "to the surface of one, to the points of the other"
    return to, f"; below about {floor:.2g} they measure the spacing of the points and no error"


def _table(title, rows):
    columns = list(dict.fromkeys(name for row in rows.values() for name in row))
    head = max(len(name) for name in [*rows, ""])
    widths = {name: max(len(name), 10) for name in columns}
    lines = [title, " " * head + "".join(f"  {name:>{widths[name]}}" for name in columns)]
    for name, row in rows.items():
        cells = ("" if x is None else f"{x:d}" if isinstance(x, int) else f"{x:.5g}" for x in map(row.get, columns))
        lines.append(f"{name:<{head}}" + "".join(f"  {cell:>{widths[c]}}" for cell, c in zip(cells, columns)))
    return "\n".join(map(plain, [*lines, "", ""]))
