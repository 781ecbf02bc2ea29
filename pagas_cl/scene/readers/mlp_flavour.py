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
    apart = max((abs(raster.size[1] - 2 * raster.center[1] - 0.5) for raster in project.rasters), default=0.0)
    what = f"{project.path}: CenterPx.y"
    if apart < _SAME:
        return "meshlab", f"{what} reads the same from the top and from the bottom (within {_SAME:g} pixel)"
    unsettled = f"{what} was read from the bottom, as MeshLab writes it, {apart:.4g} pixels from the other reading"
    try:
        scores = _scores(project)
    except (InputError, MissingExtraError) as error:
        return "meshlab", f"{unsettled}; photos could not settle it ({error})"
    if not scores:
        return "meshlab", f"{unsettled}; photos could not settle it (too few textured patches are seen by two views)"
    medians = [float(np.nanmedian(scores[f])) for f in FLAVOURS]
    agreement = f"(correlation {medians[0]:.2f} from the bottom, {medians[1]:.2f} from the top)"
    if patches.prefers(scores["openmvs"], scores["meshlab"]):
        return "openmvs", (f"{what} was read from the TOP, as OpenMVS writes it: the photos prefer it {agreement}; "
                           "pass flavour='meshlab' if that is wrong")
    if patches.prefers(scores["meshlab"], scores["openmvs"]):
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


def _scores(project: Project) -> dict[str, np.ndarray]:
    """For each flavour correlations of patches between pairs of views; of both the same pairs, of MeshLab's reading.

    Empty where too few patches can be compared.
    """
    samples = patches.sample_surface(_surface(project))
    keep = patches.evenly(len(project.rasters), _VIEWS)
    cameras = {flavour: [project.rasters[k].camera(flavour) for k in keep] for flavour in FLAVOURS}
    views = project.scene().views
    greys = [patches.grey_of(views[k].load_image()) for k in keep]
    seen, pairs = patches.overlaps(cameras["meshlab"], samples)
    scores = {f: patches.patch_correlation(cameras[f], greys, pairs, seen, samples) for f in FLAVOURS}
    return scores if min(np.isfinite(score).sum() for score in scores.values()) >= patches.LEAST else {}
