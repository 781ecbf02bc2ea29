"""Every kind of mesh that users have (Open3D, pymeshlab, arrays, files): as a Surface, and back; and with other
vertices, all else that it has carried along."""

import copy
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from pagas_cl.errors import InputError, log, need
from pagas_cl.scene.mesh import Mesh, Surface, Texture, with_normals
from pagas_cl.scene.meshes.files import read_mesh
from pagas_cl.scene.meshes.meshlab_layer import CONFIDENCE, add_custom, custom_keys, has_quality, read_custom

_MADE = ("deviation", "views")       # attributes of vertices that a refined mesh gets


def to_surface(mesh: Mesh) -> Surface:
    """Surface of any Mesh; of a MeshSet the current mesh, layer matrix applied. InputError where it is empty, of an
    unknown kind, cannot be read, or has vertices that are not finite or face indices out of range."""
    if isinstance(mesh, (str, Path)):
        return read_mesh(mesh)
    convert: dict[str, Callable[[Any], Surface]] = {
        "surface": lambda surface: surface, "pair": lambda pair: Surface(*pair), "open3d": _from_legacy,
        "open3d.t": _from_tensor, "pymeshlab": _from_pymeshlab}
    return convert[mesh_kind(mesh)](mesh)


def from_surface(surface: Surface, like: Mesh) -> Mesh:
    """`surface` as a new mesh of the kind that `like` is (a path gives the Surface itself).

    pymeshlab keeps colours in 8 bits and makes its own normals.
    """
    kind = "surface" if isinstance(like, (str, Path)) else mesh_kind(like)
    if kind == "surface":
        return surface
    if kind == "pair":
        return surface.vertices.copy(), surface.faces.copy()
    if kind == "open3d.t":
        return _to_tensor(surface, like)
    return _to_legacy(surface) if kind == "open3d" else _to_pymeshlab(surface)


def mesh_kind(mesh: Mesh) -> str:
    """"surface", "open3d", "open3d.t", "pymeshlab" or "pair"; InputError for anything else. Imports none of them."""
    if isinstance(mesh, Surface):
        return "surface"
    module, name = type(mesh).__module__, type(mesh).__name__
    if module.startswith("open3d") and name == "TriangleMesh":
        return "open3d.t" if ".t." in module or hasattr(mesh, "vertex") else "open3d"
    if module.startswith("pymeshlab") and name in ("Mesh", "MeshSet"):
        return "pymeshlab"
    if isinstance(mesh, (tuple, list)) and len(mesh) == 2:
        return "pair"
    raise InputError(f"mesh is a {module}.{name}, expected an Open3D TriangleMesh (legacy or tensor), a "
                     "pymeshlab.Mesh, a pair (vertices, faces) or the path of a mesh file")


def current_mesh(mesh: Mesh) -> Mesh:
    """Of pymeshlab's MeshSet the current mesh, else the mesh itself."""
    if hasattr(mesh, "current_mesh") and mesh.mesh_number() == 0:
        raise InputError("the mesh is empty: a pymeshlab MeshSet without meshes; load one first")
    return mesh.current_mesh() if hasattr(mesh, "current_mesh") else mesh


def _from_legacy(mesh: Any) -> Surface:
    return Surface(np.asarray(mesh.vertices), np.asarray(mesh.triangles),
                   np.array(mesh.vertex_normals) if mesh.has_vertex_normals() else None,
                   np.array(mesh.vertex_colors) if mesh.has_vertex_colors() else None)


def _to_legacy(surface: Surface) -> Mesh:
    o3d = need("open3d", "mesh", "making an Open3D mesh")
    mesh = o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(surface.vertices),
                                     o3d.utility.Vector3iVector(surface.faces))
    if surface.normals is not None:
        mesh.vertex_normals = o3d.utility.Vector3dVector(surface.normals)
    if surface.colors is not None:
        mesh.vertex_colors = o3d.utility.Vector3dVector(surface.colors)
    return mesh


def _from_tensor(mesh: Any) -> Surface:
    if "positions" not in mesh.vertex or "indices" not in mesh.triangle:
        raise InputError("the mesh is empty: an Open3D tensor mesh without vertex positions or triangle indices")
    take = {name: mesh.vertex[name].cpu().numpy() for name in ("positions", "normals", "colors", "quality")
            if name in mesh.vertex}
    colors = take.get("colors")
    if colors is not None and colors.dtype.kind in "iu":
        colors = colors / float(np.iinfo(colors.dtype).max)
    quality = take["quality"].reshape(len(take["quality"])) if "quality" in take else None
    return Surface(take["positions"], mesh.triangle["indices"].cpu().numpy(), take.get("normals"), colors, quality)


def _to_tensor(surface: Surface, like: Mesh) -> Mesh:
    o3d = need("open3d", "mesh", "making an Open3D mesh")
    mesh = o3d.t.geometry.TriangleMesh()
    mesh.vertex["positions"] = positions(surface.vertices, like)
    mesh.triangle["indices"] = o3d.core.Tensor(surface.faces.astype(np.int64))
    for name, value in [("normals", surface.normals), ("colors", surface.colors), ("quality", surface.quality),
                        *surface.attributes.items()]:
        if value is not None:
            mesh.vertex[name] = o3d.core.Tensor(np.asarray(value, np.float32).reshape(len(value), -1))
    return mesh


def positions(vertices: np.ndarray, like: Mesh) -> Any:
    """Vertices (V, 3) as an Open3D Tensor: float32 where `like` is and no millionth of the mesh's size is lost."""
    core = need("open3d", "mesh", "making an Open3D mesh").core
    single = "positions" in like.vertex and like.vertex["positions"].dtype == core.float32
    fits = np.abs(vertices).max() * 2.0**-24 < 1e-6 * np.ptp(vertices, axis=0).max()
    return core.Tensor(vertices.astype(np.float32 if single and fits else np.float64))


def _from_pymeshlab(mesh: Any) -> Surface:
    mesh = current_mesh(mesh)
    if mesh.vertex_number() == 0 or mesh.face_number() == 0:
        raise InputError(f"the mesh is empty: {mesh.vertex_number()} vertices and {mesh.face_number()} faces")
    vertices = mesh.transformed_vertex_matrix()  # with the layer's matrix, which vertex_matrix() leaves out
    colors = mesh.vertex_color_matrix()[:, :3] if mesh.has_vertex_color() else None
    quality = mesh.vertex_scalar_array() if mesh.has_vertex_scalar() else None
    return Surface(vertices, mesh.face_matrix(), None, colors, quality)


def _to_pymeshlab(surface: Surface) -> Mesh:
    pymeshlab = need("pymeshlab", "meshlab", "making a pymeshlab mesh")
    colors = surface.colors
    if colors is not None:
        colors = eight_bits(np.insert(colors, 3, 1, axis=1))
    more = {"v_normals_matrix": surface.normals, "v_color_matrix": colors, "v_scalar_array": surface.quality}
    mesh = pymeshlab.Mesh(surface.vertices, surface.faces, **{k: v for k, v in more.items() if v is not None})
    add_custom(mesh, "vertex", surface.attributes)
    return mesh


def eight_bits(colors: np.ndarray) -> np.ndarray:
    """Colours of 0 to 1 such that pymeshlab, which truncates to 8 bits, keeps them: whole numbers of 255."""
    whole: np.ndarray = np.rint(np.clip(colors, 0, 1) * 255)
    return whole / 255


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
    return {"surface": _surface, "open3d.t": _tensor, "pymeshlab": _pymeshlab}[kind](
        mesh, vertices, carry, quality, attributes, colors)


def sits_on(mesh: Mesh) -> tuple[set[str], bool]:
    """What sits on the vertices of a mesh, and whether anything sits on its faces or their corners; without what a
    refined mesh gets anew."""
    mesh, made = current_mesh(mesh), {"positions", "normals", *_MADE}
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
        if mesh.has_adjacency_list():
            new.compute_adjacency_list()
    if colors is None and mesh.has_vertex_colors():
        colors = carry.vertices(np.asarray(mesh.vertex_colors))
    if colors is not None:
        new.vertex_colors = utility.Vector3dVector(colors)
    if mesh.has_triangle_uvs():
        places = np.asarray(mesh.triangle_uvs).reshape(-1, 3, 2)
        new.triangle_uvs = utility.Vector2dVector(carry.corners(places).reshape(-1, 2))
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
    for name, values in [("quality", quality), *attributes.items()]:
        if values is not None:
            new.vertex[name] = core.Tensor(values[:, None].astype(np.float32))
    for holder in (new.vertex, new.triangle):
        if "normals" in holder:
            del holder["normals"]
    if "normals" in mesh.vertex:
        new.compute_vertex_normals()       # those of triangles, too; after these Open3D warns that there are none
    elif "normals" in mesh.triangle:
        new.compute_triangle_normals()
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
            ("w_tex_coords_matrix", "wedge_tex_coord_matrix",
             lambda places: carry.corners(places.reshape(-1, 3, 2)).reshape(-1, 2)),
            ("v_scalar_array", "vertex_scalar_array", carry.vertices)):
        if getattr(mesh, f"has_{read.rpartition('_')[0]}")():
            more[name] = carried(getattr(mesh, read)())
    if colors is not None:
        more["v_color_matrix"] = eight_bits(np.insert(colors, 3, 1, axis=1))
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
