"""The table of mesh file formats, and what a mesh would lose on its way to a file of one of them.

A new format is a module with a reader (and a writer, where it has one) and a line in FORMATS.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pagas_cl.scene.mesh import Surface
from pagas_cl.scene.meshes import gltf, obj, obj_materials, off, ply, ply_header, stl
from pagas_cl.scene.meshes.content import MeshContent, has_mark
from pagas_cl.scene.meshes.parts import Parts

_NORMALS, _COLORS, _TEXTURE, _NUMBERS = "normals", "vertex colours", "texture coordinates", "numbers"


@dataclass(frozen=True)
class MeshFormat:
    """`keeps`: what a written file holds besides triangles; `single`: whether its coordinates are float32; `is_marked`:
    whether a file of this format has the mark of pagas_cl, any exception where it is damaged."""

    read: Callable[[Path, Parts], MeshContent]
    write: Callable[[Path, Surface], None] | None = None
    keeps: tuple[str, ...] = ()
    single: bool = False
    is_marked: Callable[[Path], bool] = has_mark


FORMATS = {
    ".ply": MeshFormat(ply.read_ply, ply.write_ply, (_NORMALS, _COLORS, _NUMBERS), is_marked=ply_header.is_marked),
    ".obj": MeshFormat(obj.read_obj, obj_materials.write_obj, (_NORMALS, _COLORS, _TEXTURE)),
    ".stl": MeshFormat(stl.read_stl, stl.write_stl, single=True),
    ".off": MeshFormat(off.read_off, off.write_off, (_NORMALS, _COLORS)),
    ".glb": MeshFormat(gltf.read_gltf, gltf.write_glb, (_NORMALS, _COLORS), True, gltf.is_marked),
    ".gltf": MeshFormat(gltf.read_gltf),
}
SUFFIXES = tuple(suffix for suffix, form in FORMATS.items() if form.write is not None)     # that can be written


def losses(content: MeshContent, output: str | Path) -> list[str]:
    """In words, what a mesh file has and `output` would not have: what its reader does not carry along, and what the
    format of `output` has no place for. Normals are made anew by who reads a file without them."""
    kept = FORMATS[Path(output).suffix.lower()].keeps
    lost = list(content.lost)
    if _NUMBERS not in kept:
        names = [*["quality"] * (content.quality is not None), *content.attributes]
        lost += [f"vertex property {name!r}" for name in names]
    if _COLORS not in kept and content.colors is not None:
        lost.append(_COLORS)
    texture = content.texture
    if _TEXTURE not in kept and texture is not None:
        described = sum(bool(material.statements) for material in texture.library)
        count = described if len(texture.library) == 1 else len(texture.library)
        lost += [f"{count} material" + "s" * (count > 1)] * bool(count)
        lost += [_TEXTURE] * (texture.coordinates is not None)
    return lost
