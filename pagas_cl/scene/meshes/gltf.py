""".gltf and .glb files by trimesh: before it allocates anything their arrays are checked against the bytes that there
are, and before a file is opened its name is. Trimesh takes a second to import: only where it is needed."""

import io
import struct
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from pagas_cl.errors import InputError
from pagas_cl.scene.mesh import Surface
from pagas_cl.scene.meshes.content import MeshContent, Parts, whole
from pagas_cl.scene.own_files import TEXT_MARK
from pagas_cl.scene.untrusted import json_object
from pagas_cl.system.files import read_bytes

_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}       # of a number, by its componentType
_VALUES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_MOST_FACES = 1 << 26     # of a scene in which parts are placed many times


def read_gltf(path: Path, parts: Parts) -> MeshContent:
    """All triangles of its scene. InputError: damaged, an extension, or files that `parts` does not allow."""
    content, what = read_bytes(path, 1 << 32), f"mesh {str(path)!r}"
    tree = _tree(content, what)
    for uri in _uris(tree):
        parts.check(uri)              # as it is written, for readers that do not decode it
        parts.check(unquote(uri))
    named = {buffer["uri"] for buffer in tree.get("buffers", []) if "uri" in buffer}
    files = {uri: parts.read_uri(uri) for uri in named if not uri.startswith("data:")}
    _check_accessors(tree, len(content) + sum(map(len, files.values())), what)
    _check_nodes(tree, what)
    import trimesh

    scene = trimesh.load_scene(io.BytesIO(content), file_type="glb" if content[:4] == b"glTF" else "gltf",
                               resolver=files, process=False, skip_materials=True)
    return _joined(scene, _lost(tree), what)


def _tree(content: bytes, what: str) -> dict[str, Any]:
    """What the JSON part says."""
    if content[:4] == b"glTF":
        version, length, first, kind = struct.unpack_from("<4I", content, 4)
        if version != 2 or length > len(content) or first > length - 20 or kind != 0x4E4F534A:
            raise InputError(f"{what} claims {length} bytes, {first} of them JSON, in version {version}, and has "
                             f"{len(content)} bytes: the file is damaged or cut off")
        content = content[20:20 + first]
    return json_object(content.decode("utf-8-sig"), what)


def _uris(tree: dict[str, Any]) -> list[str]:
    """Names of files wherever they may be: in buffers, images and extensions."""
    found, left = [], [tree]
    while left:
        value: Any = left.pop()
        if isinstance(value, dict):
            found += [text for key, text in value.items() if key == "uri" and isinstance(text, str)]
        left += value.values() if isinstance(value, dict) else value if isinstance(value, list) else []
    return [uri for uri in found if not uri.startswith("data:")]


def _check_accessors(tree: dict[str, Any], size: int, what: str) -> None:
    """InputError where an array goes beyond the bytes that are there, or is stored in a way that is not read."""
    needed = {*tree.get("extensionsRequired", [])} - {"KHR_materials_unlit", "KHR_texture_transform",
                                                    "KHR_mesh_quantization"}
    if needed:
        raise InputError(f"{what} needs the glTF extension {sorted(needed)[0]!r}, which is not read: write the mesh "
                         "again without compression")
    views, taken = tree.get("bufferViews", []), 0
    for view in views:
        start, length, stride = (view.get(key, 0) for key in ("byteOffset", "byteLength", "byteStride"))
        taken += length
        if min(start, length, stride) < 0 or stride > 255 or start + length > size:
            raise InputError(f"{what} names bytes {start} to {start + length} of {size}: the file is damaged or cut "
                             "off")
    for accessor in tree.get("accessors", []):
        count, at = accessor["count"], accessor.get("byteOffset", 0)
        row = _BYTES[accessor["componentType"]] * _VALUES[accessor["type"]]
        view = views[accessor["bufferView"]] if "bufferView" in accessor else {"byteLength": 0}
        end = at + (max(count, 1) - 1) * max(view.get("byteStride", row), 1) + row
        taken += count * row
        if min(count, at) < 0 or count and end > view["byteLength"] or "sparse" in accessor:
            raise InputError(f"{what} has an array that claims {count} values and {end} bytes of the "
                             f"{view['byteLength']} that are stored for it" + ", a sparse one, which is not read"
                             * ("sparse" in accessor) + ": write the mesh again")
    if taken > 16 * size:
        raise InputError(f"{what} of {size} bytes has arrays of {taken}: is the file damaged?")


def _check_nodes(tree: dict[str, Any], what: str) -> None:
    """InputError where nodes are no tree, or one of more than 256 levels, or place a mesh that is not there."""
    nodes = tree.get("nodes", [])
    meshes = len(tree.get("meshes", []))
    for node in nodes:
        if "mesh" in node and not 0 <= node["mesh"] < meshes:
            raise InputError(f"{what}: a node places mesh {node['mesh']} of {meshes}: is the file damaged?")
    below = [child for node in nodes for child in node.get("children", [])]
    level = {*range(len(nodes))} - {*below}      # the roots
    depth = 0
    while level and depth <= 256:
        level = {child for node in level for child in nodes[node].get("children", [])}
        depth += 1
    if len({*below}) < len(below) or depth > 256:
        raise InputError(f"{what}: its nodes are no tree, or one of more than 256 levels: is the file damaged?")


def _joined(scene: Any, lost: tuple[str, ...], what: str) -> MeshContent:
    """All triangles of a trimesh.Scene in one mesh."""
    import trimesh

    placed = [(matrix, scene.geometry[name]) for matrix, name in map(scene.graph.get, scene.graph.nodes_geometry)]
    meshes = [(matrix, mesh) for matrix, mesh in placed if isinstance(mesh, trimesh.Trimesh)]
    if len(meshes) < len(placed):
        lost += ("lines and points",)
    if sum(len(mesh.faces) for _, mesh in meshes) > _MOST_FACES:
        raise InputError(f"{what} places its parts so often that they have more than {_MOST_FACES} triangles")
    vertices, faces, normals, colors = [np.empty((0, 3))], [np.empty((0, 3), np.int64)], [], []
    start = 0
    for matrix, mesh in meshes:
        turned = np.linalg.det(matrix[:3, :3]) < 0
        corners = whole(np.asarray(mesh.faces).reshape(-1), f"{what}: a face names vertex", 0, len(mesh.vertices) - 1)
        faces.append(corners.reshape(-1, 3)[:, ::-1 if turned else 1] + start)
        vertices.append(mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3])
        start += len(mesh.vertices)
        if "vertex_normals" in mesh._cache.cache:
            across = mesh.vertex_normals @ np.linalg.pinv(matrix[:3, :3])
            normals.append(across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), np.finfo(float).tiny))
        if isinstance(mesh.visual, trimesh.visual.ColorVisuals) and mesh.visual.kind == "vertex":
            colors.append(mesh.visual.vertex_colors[:, :3] / 255)
    if 0 < len(colors) < len(meshes):
        lost += ("vertex colours, which not all parts have",)
    return MeshContent(np.concatenate(vertices), np.concatenate(faces),
                       np.concatenate(normals) if meshes and len(normals) == len(meshes) else None,
                       np.concatenate(colors) if meshes and len(colors) == len(meshes) else None, lost=lost)


def _lost(tree: dict[str, Any]) -> tuple[str, ...]:
    primitives = [primitive for mesh in tree.get("meshes", []) for primitive in mesh.get("primitives", [])]
    attributes = {name for primitive in primitives for name in primitive.get("attributes", {})}
    materials = len(tree.get("materials", []))
    lost = [f"{materials} material" + "s" * (materials > 1)] * bool(materials)
    if any(name.startswith("TEXCOORD") for name in attributes):
        lost.append("texture coordinates")
    lost += [f"vertex property {name!r}" for name in sorted(attributes) if name.startswith("_")]
    return (*lost, *["animations"] * bool(tree.get("animations")), *["skins"] * bool(tree.get("skins")))


def write_glb(path: Path, surface: Surface) -> None:
    """Triangles as float32 (`files.check_digits` says whether that is enough), with normals and 8 bit colours."""
    import trimesh

    colors = None
    if surface.colors is not None:
        colors = np.rint(np.clip(surface.colors, 0, 1) * 255).astype(np.uint8)
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, vertex_normals=surface.normals, vertex_colors=colors,
                           process=False)

    scene: Any = mesh.scene()
    path.write_bytes(scene.export(file_type="glb", include_normals=surface.normals is not None,
                                  tree_postprocessor=lambda tree: tree["asset"].update(generator=TEXT_MARK)))
