"""What a mesh file holds that would be lost on the way to another file: reported before the work."""

from pathlib import Path

from pagas_cl.scene.mesh_content import MeshContent

_NORMALS, _COLORS, _TEXTURE, _NUMBERS = "normals", "vertex colours", "texture coordinates", "numbers"
_KEPT = {".ply": {_NORMALS, _COLORS, _NUMBERS}, ".obj": {_NORMALS, _COLORS, _TEXTURE}, ".off": {_NORMALS, _COLORS},
         ".glb": {_NORMALS, _COLORS}, ".stl": set()}


def losses(content: MeshContent, output: str | Path) -> list[str]:
    """In words, what a mesh file has and `output` would not have: what its reader does not carry along, and what the
    kind of `output` has no place for. Normals are made anew by who reads a file without them."""
    kept, lost = _KEPT[Path(output).suffix.lower()], list(content.lost)
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
