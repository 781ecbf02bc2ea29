"""What a mesh file holds that would be lost on the way through Open3D to another file: asked before the work.

The tables are what scene.mesh_attributes and scene.mesh_file carry along; who teaches them more adds it here.
"""

from pathlib import Path

from pagas_cl.scene.files import opened
from pagas_cl.scene.ply import keeps_numbers

_KEPT = {"vertex": {"x", "y", "z", "nx", "ny", "nz", "red", "green", "blue"},
         "face": {"vertex_indices", "vertex_index"}}
_MANY = {b"usemtl": "materials", b"g": "groups", b"o": "objects"}      # one of each is a name, several are parts


def losses(mesh: str | Path, output: str | Path) -> list[str]:
    """In words, what the .ply or .obj file `mesh` has and `output` would not have; of other kinds nothing is known."""
    mesh, kind = Path(mesh), Path(output).suffix.lower()
    if mesh.suffix.lower() == ".ply":
        lost, has = _of_ply(mesh, kind == ".ply" and keeps_numbers(mesh))
    elif mesh.suffix.lower() == ".obj":
        lost, has = _of_obj(mesh)
    else:
        return []
    if "texture coordinates" in has and kind != ".obj":
        lost.append("texture coordinates")
    if "vertex colours" in has and kind == ".stl":
        lost.append("vertex colours")
    return lost


def _of_ply(path: Path, numbers: bool) -> tuple[list[str], set[str]]:
    """What is lost in any case, and what is there for kinds of files that have it; all `numbers` of vertices may be
    kept."""
    lost, has, element = [], set(), ""
    with opened(path, 1 << 40) as file:
        header = file.read(1 << 16).partition(b"end_header")[0].decode("ascii", "replace")
    for words in (line.split() for line in header.splitlines()):
        if words[:1] == ["element"] and len(words) == 3:
            element = words[1]
            if element not in _KEPT and words[2] != "0":
                lost.append(f"elements {element!r}")
        elif (words[:1] == ["property"] and element in _KEPT and words[-1] not in _KEPT[element]
              and not (numbers and element == "vertex")):
            lost.append(f"{element} property {words[-1]!r}")
        elif words[:1] == ["property"] and words[-1] == "red":
            has.add("vertex colours")
    return lost, has


def _of_obj(path: Path) -> tuple[list[str], set[str]]:
    found: dict[bytes, set[bytes]] = {word: set() for word in _MANY}
    has = set()
    with opened(path, 1 << 40) as file:
        for line in file:
            word, _, rest = line.strip().partition(b" ")
            if word in found:
                found[word].add(rest)
            elif word == b"vt":
                has.add("texture coordinates")
            elif word == b"v" and len(rest.split()) >= 6:
                has.add("vertex colours")
    return [f"{len(names)} {_MANY[word]}" for word, names in found.items() if len(names) > 1], has
