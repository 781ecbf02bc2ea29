"""pymeshlab's Mesh, and the current one of a MeshSet, as a kind of mesh."""

from typing import Any

import numpy as np

from pagas_cl.errors import InputError, log, need
from pagas_cl.scene.mesh import Change, Mesh, MeshKind, Surface
from pagas_cl.scene.meshes.meshlab_layer import add_custom, custom_keys, has_quality, read_custom

_DOING, _READING = "making a pymeshlab mesh", "reading a pymeshlab mesh"


def current_mesh(mesh: Any) -> Any:
    """Of a MeshSet the current mesh, else the mesh itself."""
    if not hasattr(mesh, "current_mesh"):
        return mesh
    if mesh.mesh_number() == 0:
        raise InputError("the mesh is empty: a pymeshlab MeshSet without meshes; load one first")
    current = mesh.current_mesh()
    if mesh.mesh_number() > 1 and not current.face_number():
        raise InputError(f"the current layer {current.label()!r} has {current.vertex_number()} vertices and no faces: "
                         "make another layer the current one (set_current_mesh, or --layer of 'pagas-cl script')")
    return current


def _to_surface(mesh: Any) -> Surface:
    mesh = current_mesh(mesh)
    vertices = mesh.transformed_vertex_matrix()  # with the layer's matrix, which vertex_matrix() leaves out
    colors = mesh.vertex_color_matrix()[:, :3] if mesh.has_vertex_color() else None
    quality = mesh.vertex_scalar_array() if mesh.has_vertex_scalar() else None
    return Surface(vertices, mesh.face_matrix(), None, colors, quality)


def _from_surface(surface: Surface, like: Any) -> Mesh:
    pymeshlab = need("pymeshlab", "meshlab", _DOING)
    colors = None if surface.colors is None else _with_alpha(surface.colors)
    more = {"v_normals_matrix": surface.normals, "v_color_matrix": colors, "v_scalar_array": surface.quality}
    mesh = pymeshlab.Mesh(surface.vertices, surface.faces, **{k: v for k, v in more.items() if v is not None})
    add_custom(mesh, "vertex", surface.attributes)
    return mesh


def _eight_bits(colors: np.ndarray) -> np.ndarray:
    """Colours of 0 to 1 such that pymeshlab, which truncates to 8 bits, keeps them: whole numbers of 255."""
    whole: np.ndarray = np.rint(np.clip(colors, 0, 1) * 255)
    return whole / 255


def _with_alpha(colors: np.ndarray) -> np.ndarray:
    return _eight_bits(np.insert(colors, 3, 1, axis=1))


def _changed(mesh: Any, change: Change) -> Mesh:
    pymeshlab, mesh, split = need("pymeshlab", "meshlab", _DOING), current_mesh(mesh), change.split
    more, alone = {}, pymeshlab.MeshSet()
    alone.add_mesh(mesh)       # only a set of meshes says what attributes there are
    custom, unread = read_custom(alone)
    if unread:
        log.warning("not kept: custom attributes %s: pymeshlab lists their names in small letters alone",
                    ", ".join(map(repr, unread)))
    for name, read, carried in (  # of the new mesh's argument, of the old one's method, and how it comes along
            ("v_color_matrix", "vertex_color_matrix", lambda colors: _eight_bits(split.vertices(colors))),
            ("f_color_matrix", "face_color_matrix", lambda colors: _eight_bits(split.on_faces(colors))),
            ("f_scalar_array", "face_scalar_array", split.on_faces),
            ("v_tex_coords_matrix", "vertex_tex_coord_matrix", split.vertices),
            ("w_tex_coords_matrix", "wedge_tex_coord_matrix",
             lambda places: split.corners(places.reshape(-1, 3, 2)).reshape(-1, 2)),
            ("v_scalar_array", "vertex_scalar_array", split.vertices)):
        if getattr(mesh, f"has_{read.rpartition('_')[0]}")():
            more[name] = carried(getattr(mesh, read)())
    if change.colors is not None:
        more["v_color_matrix"] = _with_alpha(change.colors)
    if change.quality is not None:
        more["v_scalar_array"] = change.quality
    if mesh.texture_number():
        log.warning("a new pymeshlab.Mesh cannot be given textures: its texture coordinates are kept, the %d texture "
                    "images must be set again (set_texture_per_mesh); the MeshSet step keeps them",
                    mesh.texture_number())
    new = pymeshlab.Mesh(change.vertices, mesh.face_matrix() if split.faces is None else split.faces, **more)
    kept = {name: split.vertices(column) for name, column in custom["vertex"].items()}
    add_custom(new, "vertex", {**kept, **change.attributes})
    add_custom(new, "face", {name: split.on_faces(column) for name, column in custom["face"].items()})
    return new


def _sits_on(mesh: Any) -> tuple[set[str], bool]:
    mesh, alone = current_mesh(mesh), need("pymeshlab", "meshlab", _READING).MeshSet()
    alone.add_mesh(mesh)
    keys = custom_keys(alone)
    own = {key[len("__ca_vs__"):] for key in keys if key.startswith("__ca_v")}
    own |= {name for name, has in (("colors", mesh.has_vertex_color()), ("quality", has_quality(mesh)),
                                   ("places in an image", mesh.has_vertex_tex_coord())) if has}
    return own, (mesh.has_wedge_tex_coord() or mesh.has_face_color() or mesh.has_face_scalar()
                 or any(key.startswith("__ca_f") for key in keys))


PYMESHLAB = MeshKind(_to_surface, _from_surface, _changed, _sits_on, lambda mesh: has_quality(current_mesh(mesh)))
