"""What pymeshlab knows of the MeshLab filters that a script names: which exist, which parameters they take.

Nothing here is a list that ages: the installed pymeshlab is probed, in a child process, since some filters abort it.
Each question is [MeshLab name, pymeshlab name or null], each answer the fields of Known.
"""

import os
import re
import tempfile
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from xml.etree import ElementTree

from pagas_cl.errors import InputError, need
from pagas_cl.system import child

UNKNOWN = "Something really bad happened"  # pymeshlab's words for a filter name that it does not know
_SECONDS = 60.0  # for one child process; a filter with default values on a small sphere takes milliseconds


@dataclass(frozen=True)
class Known:
    """A MeshLab filter: `types` maps parameter names to Rich types (None where pymeshlab has not listed them),
    `crash` says how trying it ended the process (None: it did not)."""

    exists: bool
    types: dict | None = None
    enums: dict | None = None
    crash: str | None = None
    spelling: str | None = None


_answers: dict[str, Known] = {}


def look_up(names: list[str]) -> dict[str, Known]:
    """What pymeshlab knows of each name; remembered for the life of the process."""
    ask = [name for name in dict.fromkeys(names) if name not in _answers]
    if ask:
        _ask([(name, python_name(name)) for name in ask])
    return {name: _answers[name] for name in names}


def nearest(name: str) -> str:
    """The MeshLab filter whose name is most like `name`, in MeshLab's own spelling where pymeshlab has it."""
    key = get_close_matches(_plain(name), _names(), n=1, cutoff=0.0)[0]
    probe = f"?{key}"
    if probe not in _answers:
        _ask([(probe, _names()[key])])
    return _answers[probe].spelling or key.replace("_", " ")


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")


@cache
def _names() -> dict[str, str]:
    """MeshLab's names in plain letters -> pymeshlab's names, from the table that pymeshlab brings for old scripts."""
    pymeshlab = need("pymeshlab", "meshlab", "running a filter script")
    known = set(pymeshlab.filter_list())
    table = Path(pymeshlab.__file__).with_name("keys.txt")
    names = {name: name for name in known}
    if table.is_file():
        pairs = (line.split() for line in table.read_text(encoding="utf-8").splitlines())
        names.update({pair[0]: pair[1] for pair in pairs if len(pair) == 2 and pair[1] in known})
    return names


def python_name(name: str) -> str | None:
    """pymeshlab's name of the filter that MeshLab calls `name`, where its table has it."""
    return _names().get(_plain(name))


def _ask(questions: list[tuple[str, str | None]]) -> None:
    """Fill `_answers`; where the child dies others get half of the questions each, down to the one it dies of."""
    need("pymeshlab", "meshlab", "running a filter script")
    answer = child.ask("pagas_cl.filters.native", {"filters": questions}, _SECONDS)
    if answer.value is not None:
        _answers.update({name: Known(**fields) for name, fields in answer.value["filters"].items()})
    elif not (answer.crashed or answer.hung):
        raise InputError(f"pymeshlab cannot list its filters: the child process {answer.fault}")
    elif len(questions) == 1:
        _answers[questions[0][0]] = Known(True, crash=answer.fault)
    else:
        middle = len(questions) // 2
        _ask(questions[:middle])
        _ask(questions[middle:])


# -- in the child ------------------------------------------------------------------------------------------------------


def answers_to(filters: list[tuple[str, str | None]]) -> dict[str, dict]:
    """{"filters": name -> answer}."""
    import pymeshlab

    answers = {}
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)      # some filters write files when they are tried
        path = Path(folder) / "probe.mlx"
        for name, python in filters:
            written = None if python is None else _written(pymeshlab, python, path)
            matches = written is not None and written.get("name") == name
            answers[name] = {"exists": matches or _is_known(pymeshlab, name, path),
                             "spelling": None if written is None else written.get("name")}
            if matches:
                answers[name]["types"] = {p.get("name"): p.get("type") for p in written}
                answers[name]["enums"] = {p.get("name"): int(p.get("enum_cardinality")) for p in written
                                          if p.get("enum_cardinality")}
        os.chdir(os.sep)
    return {"filters": answers}


def _scratch(pymeshlab):
    """Two small spheres with every attribute that a filter may ask for."""
    meshes = pymeshlab.MeshSet()
    for _ in range(2):
        meshes.create_sphere(subdiv=2)
        mesh = meshes.current_mesh()
        vertices, faces = mesh.vertex_matrix(), mesh.face_matrix()
        rgba = abs(vertices[:, [0, 1, 2, 0]])
        rgba[:, 3] = 1
        meshes.add_mesh(pymeshlab.Mesh(vertices, faces, v_color_matrix=rgba, f_color_matrix=rgba[faces[:, 0]],
                                       v_scalar_array=vertices[:, 0].copy(), f_scalar_array=vertices[faces[:, 0], 0],
                                       w_tex_coords_matrix=abs(vertices[faces.ravel(), :2])), "sphere")
        meshes.set_selection_all()
    meshes.clear_filter_script()
    return meshes


def _written(pymeshlab, python: str, path: Path):
    """What the history has of a filter, applied by its pymeshlab name with defaults; None where it refuses."""
    meshes = _scratch(pymeshlab)
    try:
        meshes.apply_filter(python)
        meshes.save_filter_script(str(path))
        return ElementTree.parse(path).getroot().find("filter")
    except (pymeshlab.PyMeshLabException, RuntimeError, OSError, ElementTree.ParseError):
        return None


def _is_known(pymeshlab, name: str, path: Path) -> bool:
    """Whether a script with just this name is more than an unknown filter to pymeshlab."""
    root = ElementTree.Element("FilterScript")
    ElementTree.SubElement(root, "filter", name=name)
    path.write_text("<!DOCTYPE FilterScript>\n" + ElementTree.tostring(root, encoding="unicode"), encoding="utf-8")
    meshes = _scratch(pymeshlab)
    meshes.load_filter_script(str(path))
    try:
        meshes.apply_filter_script()
    except (pymeshlab.PyMeshLabException, RuntimeError) as error:
        return UNKNOWN not in str(error)
    return True


if __name__ == "__main__":
    child.answer(answers_to)
