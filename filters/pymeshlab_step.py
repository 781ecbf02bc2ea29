"""Our step as a method of pymeshlab's MeshSet.

    register()                                       # once: MeshSet gets apply_pagas_depth_refinement
    meshes.apply_pagas_depth_refinement("SCENE")     # refines the current layer with the photos of SCENE
"""

import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from pagas_cl.errors import InputError, kind_of, log, need
from pagas_cl.filters.file_kinds import contents_of
from pagas_cl.filters.history import CALL, HINT, METHOD, add_name, attribute_names, restore_history, saved_history
from pagas_cl.filters.parameters import FILTER, PARAMETERS, Request, request, to_values
from pagas_cl.jobs.fusing import fuse_results
from pagas_cl.jobs.place import Place
from pagas_cl.method.cameras.effect import resolve_cameras
from pagas_cl.method.surface.keep_mesh import kept_mesh, solve_device
from pagas_cl.method.surface.mesh_evidence import Observations
from pagas_cl.method.surface.mesh_options import MeshOptions
from pagas_cl.method.surface.mesh_solve import solve_mesh
from pagas_cl.method.surface.on_vertices import footprints, vertex_confidence
from pagas_cl.progress import progress_of
from pagas_cl.refine import initial_depths, refine_views
from pagas_cl.scene.inputs import as_views
from pagas_cl.scene.mesh import triangle_normals
from pagas_cl.scene.meshes import meshlab_layer as layers
from pagas_cl.scene.meshes.kinds import from_surface, to_surface
from pagas_cl.scene.meshes.pymeshlab_meshes import current_mesh
from pagas_cl.scene.readers import read_scene
from pagas_cl.scene.view import Scene, View

_MOST_FACES = 40_000_000


def register(meshes=None):
    """Add the step as a method, apply_pagas_depth_refinement, which `apply_filter` knows, too; returns its class.

    `meshes`: a class of pymeshlab.MeshSet (by default that itself), or an object, whose class is extended, since its
    objects take no attributes.
    """
    kind = need("pymeshlab", "meshlab", "the MeshLab step").MeshSet
    if meshes is not None:
        kind = meshes if isinstance(meshes, type) else type(meshes)
    if not hasattr(kind, "current_mesh"):
        raise InputError(f"{kind.__name__} is no pymeshlab.MeshSet: it has no current_mesh")
    setattr(kind, METHOD, apply_pagas_depth_refinement)
    add_name(kind, apply_pagas_depth_refinement)
    return kind


def apply_pagas_depth_refinement(self, scene, *, preset: str = "balanced", output: str = "mesh", subdivide: float = 0.0,
                                 triangles: int = 0, context_views: int | None = None, radius: float | None = None,
                                 smoothness: float | None = None, max_move: float | None = None,
                                 voxel: float | None = None, agree_views: int | None = None, effects: str = "",
                                 settings: str = "", device: str = "", progress=None) -> dict:
    """Refine the current layer with photos (PAGaS, arXiv 2604.22129).

    Parameters
    ----------
    scene : folder, Scene, list of View, or (cameras, images)
        Photos and cameras, in the world that the layer's matrix leads to.
    preset : str
        Settings to start from; those below that are None keep the preset's value.
    output : str
        "mesh": a new layer, the current one's mesh refined, becomes the current one, with all that the current one has
        but a selection (colours, quality, textures, custom attributes; mean values on new vertices, a face's own on its
        parts).
        "tsdf": a new layer fused from the refined depths, with colours alone. "displace": the vertices of the current
        layer move; its topology, textures and attributes stay.
    subdivide : float
        First split edges longer than this many pixel footprints: with "displace" all of them, 0 none; with "mesh"
        those that depths lie off, 0 for 1.5.
    triangles : int
        With "mesh": how many triangles the new layer has, within 2 %; 0: as many as the detail needs.
    context_views, radius, smoothness, max_move, voxel, agree_views
        Most context views; radius threshold (pixels); smoothness weight; largest move (pixels of parallax); voxel edge
        (pixel footprints); how many other views must confirm a depth.
    effects : str
        Effects to simulate or not, "exposure=off; occlusion=on".
    settings : str
        Any other settings, "stage.field=value; stage.field=value".
    device : str
        Part of an OpenCL device's name.
    progress : True (where it is left out), False, a function (stage, done, total), or a Progress
        Shown on standard error where it is left out; False shows none.

    Returns
    -------
    dict
        Pixels refined, kept, rejected, over all views. Confidence is the layer's vertex quality or, where it has one
        already, the custom attribute "pagas_confidence". The step is in the history, so that save_filter_script writes
        it.
    """
    values = to_values(locals())
    requested, history = request(values, FILTER), saved_history(self)
    try:
        counts = refine_layer(self, scene_views(scene), requested, progress=True if progress is None else progress,
                              spellings=attribute_names(history))
        element = ElementTree.Element("filter", name=FILTER)
        for p in (p for p in PARAMETERS if p.name in values):
            ElementTree.SubElement(element, "Param", type=p.rich, name=p.name, value=values[p.name],
                                   description=p.description, tooltip="")
        ElementTree.SubElement(element, "Param", type="RichString", name=HINT, value=CALL, description="", tooltip="")
        history.append(element)
    finally:
        restore_history(self, history)
    return counts


def scene_views(scene) -> list[View]:
    """Views of a folder, a Scene, a list of View, or a pair (cameras, images)."""
    if scene is None:
        raise InputError(f"the step {FILTER!r} needs a scene: a folder with photos and cameras (SCENE of 'pagas-cl "
                         "script'), a Scene, or views")
    if isinstance(scene, (str, Path)):
        return read_scene(scene).views
    if isinstance(scene, Scene):
        return scene.views
    if isinstance(scene, tuple) and len(scene) == 2 and not isinstance(scene[0], View):
        return as_views(*scene)
    if isinstance(scene, (list, tuple)) and scene and all(isinstance(view, View) for view in scene):
        return list(scene)
    raise InputError(f"scene is {kind_of(scene)}, expected a folder, a Scene, a list of View, or a pair "
                     "(cameras, images)")


def refine_layer(meshes, views: list[View], requested: Request, *, progress=None, spellings=()) -> dict:
    """What the method and the script share; `spellings`: names that custom attributes may have."""
    layer = current_mesh(meshes)
    label, matrix = f"{layer.label()} refined", np.array(layer.transform_matrix())
    surface = to_surface(layer)  # the layer's matrix applied
    making, device, shown = requested.making, requested.device, progress_of(progress)
    _check_attributes(meshes, making, spellings)
    if making.output == "displace":
        surface = replace(surface, quality=None, colors=None, normals=None)
    views, config, _ = resolve_cameras(views, surface, requested.config, device, shown)
    depths = initial_depths(surface, views, shown, device=device)
    if making.output == "displace" and making.subdivide is not None:
        surface = _subdivided(meshes, surface, views, depths, making.subdivide, matrix)
    results = refine_views(views, depths, config=config, device=device, progress=shown)
    if making.output == "displace":
        _displace_layer(meshes, surface, results, requested, matrix)
    elif making.output == "tsdf":
        made = fuse_results(views, results, config, shown, place=Place(device))
        quality = vertex_confidence(made.vertices, results)
        made = replace(made, vertices=_local(made.vertices, matrix), quality=quality, normals=None)
        meshes.add_mesh(from_surface(replace(made, attributes={}), like=layer), label)
        layers.add_custom(meshes.current_mesh(), "vertex", made.attributes)   # what add_mesh copies ends the process
        _finish_layer(meshes, label, matrix)
    else:
        kept_mesh(layer, views, results, config, making, device, shown,
                  partial(_add_layer, meshes, results, label, matrix, spellings))
    return {key: sum(result.counts[key] for result in results) for key in results[0].counts}


def _check_attributes(meshes, making: MeshOptions, spellings) -> None:
    """Before the work: what the layer has that `making` cannot take along; InputError where it cannot be refined."""
    layer, (custom, unread) = meshes.current_mesh(), layers.read_custom(meshes, spellings)
    names = [f"custom attribute {name!r}" for name in (*custom["vertex"], *custom["face"], *unread)]
    if making.output == "tsdf":
        names += sorted(contents_of(layer) - {"vertex colours"})
        _log_lost(names, f"output='tsdf' fuses a new layer, which has nothing of {layer.label()!r} (output='mesh' has)")
    elif making.output == "mesh":
        _log_lost([f"custom attribute {name!r}" for name in unread], "pymeshlab lists names in small letters alone")
        twice = int((np.diff(np.sort(layer.face_matrix(), axis=1), axis=1) == 0).any(axis=1).sum())
        if twice:
            raise InputError(f"{twice} of the {layer.face_number()} faces of {layer.label()!r} name one vertex twice, "
                             "which pymeshlab leaves out of files: apply meshing_remove_null_faces first")
    elif making.subdivide is not None:
        _log_lost(names, "MeshLab splits edges within a layer, and leaves 0 on what it makes (output='mesh' carries)")
    if making.output == "displace":
        try:
            meshes.compute_coord_by_function(x="x", y="y", z="z", onselected=False)
        except RuntimeError as error:
            raise InputError("MeshLab cannot move vertices by its expressions while the name of a custom attribute has "
                             "other characters than letters, digits and _: rename it, or use output='mesh'") from error


def _log_lost(names: list[str], why: str) -> None:
    if names:
        log.warning("not kept: %s: %s", ", ".join(names), why)


def _local(vertices: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """World coordinates in the layer's own frame."""
    return np.linalg.solve(matrix[:3, :3], (vertices - matrix[:3, 3]).T).T


def _add_layer(meshes, results, label: str, matrix: np.ndarray, spellings, _surface, vertices, division, _quality,
               attributes) -> None:
    """The current layer, divided, its vertices (world coordinates) moved, as a new one; arguments as with_vertices'."""
    with tempfile.TemporaryDirectory() as folder:
        layer, places = layers.read_layer(meshes, Path(folder), spellings), _local(vertices, matrix)
        if division is None:
            layer = replace(layer, vertex={**layer.vertex, **dict(zip("xyz", places.T))})
        else:
            layer = layer.carried(places, division)
        confidence, vertex, custom = vertex_confidence(vertices, results), layer.vertex, layer.custom["vertex"]
        if layers.has_quality(meshes.current_mesh()):
            _log_quality(label)
            attributes = {**attributes, layers.CONFIDENCE: confidence}
        else:
            vertex = {**vertex, "quality": confidence}
        custom = {"vertex": {**custom, **attributes}, "face": layer.custom["face"]}
        layers.load_layer(meshes, replace(layer, vertex=vertex, custom=custom), Path(folder))
    _finish_layer(meshes, label, matrix)


def _log_quality(label: str) -> None:
    log.info("%s: the layer's vertex quality stays, the confidence is the custom attribute %r", label,
             layers.CONFIDENCE)


def _finish_layer(meshes, label: str, matrix: np.ndarray) -> None:
    """The old layer's matrix and unit normals: pymeshlab drops given ones and makes its own, not of unit length."""
    meshes.current_mesh().set_label(label)
    if not np.array_equal(matrix, np.eye(4)):
        meshes.set_matrix(transformmatrix=matrix, freeze=False)
    meshes.compute_normal_per_vertex()


def _displace_layer(meshes, surface, results, requested: Request, matrix: np.ndarray) -> None:
    """Move the current layer's vertices where they are: pymeshlab's meshes take no new positions from outside, but its
    filters can copy vertex attributes, exactly, into positions, quality and other attributes."""
    solved = solve_mesh(surface, Observations(results), solve_device(requested.device),
                        least_views=max(1, requested.config.fusion.agree_views) + 1)
    moved = (solved.vertices != surface.vertices).any(axis=1)
    quality = np.where(moved, vertex_confidence(solved.vertices, results), 0)
    layer = meshes.current_mesh()
    # vertices that stayed keep their bits: they are not sent through the matrix and back
    local = np.where(moved[:, None], _local(solved.vertices, matrix), layer.vertex_matrix())
    taken = sum(layers.SCRATCH in key for key in meshes.filter_parameter_values("ply"))      # pymeshlab removes none
    names = [f"{layers.SCRATCH}{axis}{taken}" for axis in "xyzq"]      # letters and digits, all that expressions take
    layers.add_custom(layer, "vertex", dict(zip(names, (*local.T, quality))))
    meshes.compute_coord_by_function(x=names[0], y=names[1], z=names[2], onselected=False)
    if layers.has_quality(layer):
        _log_quality(layer.label())
        meshes.compute_new_custom_scalar_attribute_per_vertex(name=layers.CONFIDENCE, expr=names[3])
    else:
        meshes.compute_scalar_by_function_per_vertex(q=names[3], onselected=False)
    meshes.compute_normal_per_vertex()
    if not np.array_equal(layer.vertex_matrix(), local):
        raise InputError("this pymeshlab does not copy vertex attributes into positions exactly; use output='tsdf'")


def _subdivided(meshes, surface, views, depths, footprint_edges: float, matrix: np.ndarray):
    """Split the current layer's long edges by pymeshlab's own filter, which keeps textures and attributes."""
    import pymeshlab

    finest = footprints(surface.vertices, [view.camera for view in views], depths)
    if not np.isfinite(finest).any():
        raise InputError("no view sees a vertex of the layer, so that its pixel footprint is unknown")
    longest = footprint_edges * float(np.median(finest[np.isfinite(finest)]))
    area = np.linalg.norm(triangle_normals(surface.vertices, surface.faces), axis=1) / 2
    faces = float((1 + area / (0.1 * longest**2)).sum())
    if faces > _MOST_FACES:
        raise InputError(f"subdividing to {footprint_edges:g} pixel footprints would make some {faces:.2g} faces, more "
                         f"than {_MOST_FACES:.0e}; use a larger number")
    scale = np.cbrt(abs(np.linalg.det(matrix[:3, :3])))
    meshes.meshing_surface_subdivision_midpoint(iterations=12, threshold=pymeshlab.PureValue(longest / scale),
                                                selected=False)     # by default True where a face is selected
    return replace(to_surface(meshes.current_mesh()), quality=None, colors=None, normals=None)
