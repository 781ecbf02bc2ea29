"""Which way a MeshLab project counts CenterPx.y: settled by its own photos over its own mesh."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pagas_cl.errors import InputError, MissingExtraError
from pagas_cl.scene import patches
from pagas_cl.scene.mesh import Surface
from pagas_cl.scene.mesh_file import read_mesh

if TYPE_CHECKING:
    from pagas_cl.scene.readers.meshlab import Project

FLAVOURS = ("meshlab", "openmvs")
_SAME = 1.0   # pixels: readings nearer than this need no settling
_VIEWS = 8


def settle_flavour(project: Project) -> tuple[str, str]:
    """("meshlab" or "openmvs", one sentence that says why) for a meshlab.Project.

    Both readings are tried: patches of the project's mesh are correlated between pairs of its photos. MeshLab's own
    reading is taken where the two hardly differ, where there is no mesh or photo to compare, and where the photos do
    not prefer the other one.
    """
    apart = project.readings_differ()
    what = f"{project.path}: CenterPx.y"
    if apart < _SAME:
        return "meshlab", f"{what} reads the same from the top and from the bottom (within {_SAME:g} pixel)"
    unsettled = f"{what} was read from the bottom, as MeshLab writes it, {apart:.4g} pixels from the other reading"
    try:
        surface = _surface(project)
        found = {flavour: _score(project, surface, flavour) for flavour in FLAVOURS}
    except (InputError, MissingExtraError) as error:
        return "meshlab", f"{unsettled}; photos could not settle it ({error})"
    scores = {flavour: score for flavour, score in found.items() if score is not None}
    if len(scores) < len(FLAVOURS):
        return "meshlab", f"{unsettled}; photos could not settle it (too few textured patches are seen by two views)"
    better = {f: patches.prefers(scores[f], scores[FLAVOURS[1 - i]]) for i, f in enumerate(FLAVOURS)}
    medians = {f: float(np.nanmedian(score)) for f, score in scores.items()}
    agreement = f"(correlation {medians['meshlab']:.2f} from the bottom, {medians['openmvs']:.2f} from the top)"
    if better["openmvs"]:
        return "openmvs", (f"{what} was read from the TOP, as OpenMVS writes it: the photos prefer it {agreement}; "
                           "pass flavour='meshlab' if that is wrong")
    if better["meshlab"]:
        return "meshlab", f"{what} was read from the bottom, as MeshLab writes it; the photos agree {agreement}"
    return "meshlab", (f"{unsettled}; the photos prefer neither {agreement}: pass flavour='openmvs' if OpenMVS wrote "
                       "the file")


def _surface(project: Project) -> Surface:
    """The first visible mesh layer in the project's world."""
    for layer in project.meshes:
        if layer.visible and layer.path is not None:
            surface = read_mesh(layer.path)
            return Surface(surface.vertices @ layer.matrix[:3, :3].T + layer.matrix[:3, 3], surface.faces)
    raise InputError("the project has no mesh layer with a file")


def _score(project: Project, surface: Surface, flavour: str) -> np.ndarray | None:
    """Correlations of patches between pairs of views; pairs and patches are those of MeshLab's reading."""
    keep = patches.evenly(len(project.rasters), _VIEWS)
    views = [project.scene(flavour).views[k] for k in keep]
    samples = patches.sample_surface(surface)
    seen, pairs = patches.overlaps([project.rasters[k].camera("meshlab") for k in keep], samples)
    if not pairs:
        return None
    greys = [patches.grey_of(view.load_image()) for view in views]
    scores = patches.patch_correlation([v.camera for v in views], greys, pairs, seen, samples)
    return scores if np.isfinite(scores).sum() >= patches.LEAST else None
