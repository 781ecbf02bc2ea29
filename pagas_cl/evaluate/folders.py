"""Depth maps in a folder, judged view by view: against true depth maps, or by photos that took no part."""

from __future__ import annotations

import logging

from pagas_cl.errors import InputError
from pagas_cl.evaluate.depth import compare_depth, depth_per_parallax
from pagas_cl.evaluate.predict import compare_predictions
from pagas_cl.scene.depthmap import find_depth, load_depth

_log = logging.getLogger("pagas_cl")


def depth_errors(scene, folder, truth_folder, *, scale=None) -> dict[str, dict]:
    """Errors of each view's depth map in `folder` against the one in `truth_folder`.

    Parameters
    ----------
    scene : Scene
    folder, truth_folder : path
        Depth maps named after the photos: scene.depthmap.
    scale : float or None
        The files' number for one scene unit (PNG needs it).

    Returns
    -------
    dict
        View name -> DepthReport.as_dict(); parallax is that against the nearest other view at a useful angle.
    """
    rows = {}
    for view in scene.views:
        depth, truth = (_depth(where, view, scale) for where in (folder, truth_folder))
        if depth is None or truth is None:
            continue
        others = [other.camera for other in scene.views if other is not view]
        rows[view.name] = compare_depth(depth, truth, view.camera, mask=view.load_mask(),
                                        parallax=depth_per_parallax(truth, view.camera, others)).as_dict()
    if not rows:
        raise InputError(f"no view of {scene.source or 'the scene'} has a depth map in both {str(folder)!r} and "
                         f"{str(truth_folder)!r}; they are named <image stem>.npz")
    return rows


def photo_predictions(scene, folder, held_out, *, before=None, scale=None) -> dict[str, dict]:
    """How well the depth maps in `folder` predict the photos `held_out`.

    Parameters
    ----------
    held_out : sequence of str
        Names of views whose photos took no part in refining.
    before : path or None
        Another folder, usually of the initial depth maps: both are compared on the same pixels.

    Returns
    -------
    dict
        "<view> from <held-out view>" -> {"median", "pixels"} and {"median_before"} where `before` is given.
    """
    kept_out = [scene.views[scene.index(name)] for name in held_out]
    rows = {}
    for view in scene.views:
        if view in kept_out:
            continue
        depths = [_depth(where, view, scale) for where in (folder, before) if where is not None]
        if any(depth is None for depth in depths):
            continue
        for other in kept_out:
            found = compare_predictions(view, depths, other)
            if not found[0].pixels:
                _log.warning("%s: nothing of it is seen in %s", view.name, other.name)
                continue
            row = {"median": found[0].median, "pixels": found[0].pixels}
            if before is not None:
                row["median_before"] = found[1].median
            rows[f"{view.name} from {other.name}"] = row
    if not rows:
        raise InputError(f"no photo can be predicted: no view of {scene.source or 'the scene'} with a depth map in "
                         f"{str(folder)!r} sees what a held-out view sees")
    return rows


def _depth(folder, view, scale):
    path = find_depth(folder, view.name)
    size = view.camera.width, view.camera.height
    return None if path is None else load_depth(path, size, scale=scale)
