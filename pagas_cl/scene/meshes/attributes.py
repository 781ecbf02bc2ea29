"""A mesh with new vertex positions and everything else unchanged: textures, colours, attributes, Open3D or pymeshlab.
Normals are the only thing made anew."""

import copy
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from pagas_cl.errors import log, need
from pagas_cl.scene.mesh import Mesh, Surface, Texture, with_normals
from pagas_cl.scene.meshes.kinds import current_mesh, eight_bits, mesh_kind, positions
from pagas_cl.scene.meshes.meshlab_layer import CONFIDENCE, add_custom, custom_keys, has_quality, read_custom

MADE = ("deviation", "views")       # attributes of vertices that a refined mesh gets


def with_vertices(mesh: Mesh, vertices: np.ndarray, subdivision: Any = None, quality: np.ndarray | None = None,
                  attributes: Mapping[str, np.ndarray] = MappingProxyType({}),
                  colors: np.ndarray | None = None) -> Mesh:
    """A new mesh of `mesh`'s kind with `vertices`, its faces split as `subdivision` says, all else carried along.

    `vertices` are (V', 3) float64, world coordinates; `subdivision` is a surface.subdivide.Subdivision; `quality` and
    `attributes` (V',) are for the kinds that have such: Surface, Open3D's tensor mesh, pymeshlab. A quality that `mesh`
    has stays: then `quality` becomes the attribute CONFIDENCE. `colors` (V', 3), 0 to 1, replace those of `mesh`.
    """
    carry: Any = subdivision or _Same
    mesh = current_mesh(mesh)
    kind = mesh_kind(mesh)
    if quality is not None and (kind == "surface" and mesh.quality is not None or kind == "open3d.t" and "quality" in
                                mesh.vertex or kind == "pymeshlab" and has_quality(mesh)):
        log.info("the mesh has a vertex quality, which stays: the confidence is the attribute %r", CONFIDENCE)
        attributes, quality = {**attributes, CONFIDENCE: quality}, None
    if kind == "pair":
        return vertices, np.array(mesh[1]) if carry.faces is None else carry.faces
    if kind == "open3d":
        return _legacy(mesh, vertices, carry, colors)
    make = {"surface": _surface, "open3d.t": _tensor, "pymeshlab": _pymeshlab}[kind]
    return make(mesh, vertices, carry, quality, attributes, colors)


def sits_on(mesh: Mesh) -> tuple[set[str], bool]:
    """What sits on the vertices of a mesh, and whether anything sits on its faces or their corners; without what a
    refined mesh gets anew."""
    mesh, made = current_mesh(mesh), {"positions", "normals", *MADE}
    kind = mesh_kind(mesh)
    if kind == "surface":
        own = {name for name in ("colors", "quality") if getattr(mesh, name) is not None}
        return (own | set(mesh.attributes)) - made, mesh.texture is not None
    if kind == "open3d":
        return ({"colors"} if mesh.has_vertex_colors() else set(),
                mesh.has_triangle_uvs() or mesh.has_triangle_material_ids())
    if kind == "open3d.t":
        return set(mesh.vertex) - made, bool(set(mesh.triangle) - {"indices", "normals"})
    if kind == "pair":
        return set(), False
    alone = need("pymeshlab", "meshlab", "reading a pymeshlab mesh").MeshSet()
    alone.add_mesh(mesh)
    keys = custom_keys(alone)
    own = {key[len("__ca_vs__"):] for key in keys if key.startswith("__ca_v")} - made
    own |= {name for name, has in (("colors", mesh.has_vertex_color()), ("quality", has_quality(mesh)),
                                   ("places in an image", mesh.has_vertex_tex_coord())) if has}
    return own, (mesh.has_wedge_tex_coord() or mesh.has_face_color() or mesh.has_face_scalar()
                 or any(key.startswith("__ca_f") for key in keys))


class _Same:
    """A subdivision that splits nothing."""

    faces = None

    @staticmethod
    def vertices(values: np.ndarray) -> np.ndarray:
        return values

    corners = on_faces = vertices


def _surface(mesh: Surface, vertices: np.ndarray, carry: Any, quality: np.ndarray | None,
             attributes: Mapping[str, np.ndarray], colors: np.ndarray | None) -> Surface:
    def carried(values: np.ndarray | None) -> Any:
        return None if values is None else carry.vertices(values)

    texture = mesh.texture
    if texture is not None:
        coordinates = None if texture.coordinates is None else carry.corners(texture.coordinates)
        texture = Texture(coordinates, carry.on_faces(texture.materials), texture.library)
    return with_normals(Surface(
        vertices, mesh.faces if carry.faces is None else carry.faces, None,
        carried(mesh.colors) if colors is None else colors, carried(mesh.quality) if quality is None else quality,
        {**{name: carried(value) for name, value in mesh.attributes.items()}, **attributes}, texture))


def _legacy(mesh: Mesh, vertices: np.ndarray, carry: Any, colors: np.ndarray | None) -> Mesh:
    utility = need("open3d", "mesh", "making an Open3D mesh").utility
    new = copy.deepcopy(mesh)
    new.vertices = utility.Vector3dVector(vertices)
    if carry.faces is not None:
        new.triangles = utility.Vector3iVector(carry.faces)
    if colors is None and mesh.has_vertex_colors():
        colors = carry.vertices(np.asarray(mesh.vertex_colors))
    if colors is not None:
        new.vertex_colors = utility.Vector3dVector(colors)
    if mesh.has_triangle_uvs():
        new.triangle_uvs = utility.Vector2dVector(_corners(carry, np.asarray(mesh.triangle_uvs)))
    if mesh.has_triangle_material_ids():
        new.triangle_material_ids = utility.IntVector(carry.on_faces(np.asarray(mesh.triangle_material_ids)))
    if mesh.has_triangle_normals():
        new.compute_triangle_normals()
    if mesh.has_vertex_normals():
        new.vertex_normals = utility.Vector3dVector(np.zeros((0, 3)))
        new.compute_vertex_normals()
    return new


def _tensor(mesh: Mesh, vertices: np.ndarray, carry: Any, quality: np.ndarray | None,
            attributes: Mapping[str, np.ndarray], colors: np.ndarray | None) -> Mesh:
    core = need("open3d", "mesh", "making an Open3D mesh").core
    new = mesh.clone()
    for name in set(mesh.vertex) - {"positions", "normals"}:
        new.vertex[name] = core.Tensor(carry.vertices(mesh.vertex[name].cpu().numpy()))
    for name in set(mesh.triangle) - {"indices", "normals"}:
        carried = carry.corners if name == "texture_uvs" else carry.on_faces
        new.triangle[name] = core.Tensor(carried(mesh.triangle[name].cpu().numpy()))
    new.vertex["positions"] = positions(vertices, mesh)
    if carry.faces is not None:
        new.triangle["indices"] = core.Tensor(carry.faces.astype(np.int64))
    if colors is not None:
        new.vertex["colors"] = core.Tensor(colors.astype(np.float32))
    if quality is not None:
        new.vertex["quality"] = core.Tensor(quality[:, None].astype(np.float32))
    for name, values in attributes.items():
        new.vertex[name] = core.Tensor(values[:, None].astype(np.float32))
    for holder, compute in ((new.triangle, new.compute_triangle_normals), (new.vertex, new.compute_vertex_normals)):
        if "normals" in holder:
            del holder["normals"]
            compute()
    return new


def _pymeshlab(mesh: Mesh, vertices: np.ndarray, carry: Any, quality: np.ndarray | None,
               attributes: Mapping[str, np.ndarray], colors: np.ndarray | None) -> Mesh:
    pymeshlab = need("pymeshlab", "meshlab", "making a pymeshlab mesh")
    more, alone = {}, pymeshlab.MeshSet()
    alone.add_mesh(mesh)       # only a set of meshes says what attributes there are
    custom, unread = read_custom(alone)
    if unread:
        log.warning("not kept: custom attributes %s: pymeshlab lists their names in small letters alone",
                    ", ".join(map(repr, unread)))
    for name, read, carried in (  # of the new mesh's argument, of the old one's method, and how it comes along
            ("v_color_matrix", "vertex_color_matrix", lambda colors: eight_bits(carry.vertices(colors))),
            ("f_color_matrix", "face_color_matrix", lambda colors: eight_bits(carry.on_faces(colors))),
            ("f_scalar_array", "face_scalar_array", carry.on_faces),
            ("v_tex_coords_matrix", "vertex_tex_coord_matrix", carry.vertices),
            ("w_tex_coords_matrix", "wedge_tex_coord_matrix", lambda places: _corners(carry, places)),
            ("v_scalar_array", "vertex_scalar_array", carry.vertices)):
        if getattr(mesh, f"has_{read.rpartition('_')[0]}")():
            more[name] = carried(getattr(mesh, read)())
    if colors is not None:
        more["v_color_matrix"] = eight_bits(np.column_stack([colors, np.ones(len(colors))]))
    if quality is not None:
        more["v_scalar_array"] = quality
    if mesh.texture_number():
        log.warning("a new pymeshlab.Mesh cannot be given textures: its texture coordinates are kept, the %d texture "
                    "images must be set again (set_texture_per_mesh); the MeshSet step keeps them",
                    mesh.texture_number())
    new = pymeshlab.Mesh(vertices, mesh.face_matrix() if carry.faces is None else carry.faces, **more)
    kept = {name: carry.vertices(column) for name, column in custom["vertex"].items()}
    add_custom(new, "vertex", {**kept, **attributes})
    add_custom(new, "face", {name: carry.on_faces(column) for name, column in custom["face"].items()})
    return new


def _corners(carry: Any, places: np.ndarray) -> np.ndarray:
    """Texture coordinates (3 F, 2) of the faces' corners, carried along."""
    carried: np.ndarray = carry.corners(places.reshape(-1, 3, 2))
    return carried.reshape(-1, 2)
