"""What pymeshlab makes of MeshLab filter names, asked in a process of its own: some filters abort the process.

    python -m pagas_cl.filters.native_probe QUESTIONS.json ANSWERS.jsonl

Each question is [MeshLab name, pymeshlab name or null]. Each answer is a line: {"start": name} before it is tried, then
{"name", "known", "written"}: `written` is the filter as pymeshlab itself writes it, with all parameters and types.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from xml.etree import ElementTree

UNKNOWN = "Something really bad happened"  # pymeshlab's words for a filter name that it does not know


def main(questions: str, answers: str) -> None:
    """Answer all questions, one line each, flushed at once so that a crash loses none."""
    import pymeshlab

    with open(answers, "a", encoding="utf-8") as out, tempfile.TemporaryDirectory() as folder:
        def tell(record):
            out.write(json.dumps(record) + "\n")
            out.flush()

        for name, python in json.loads(Path(questions).read_text(encoding="utf-8")):
            tell({"start": name})
            written = None if python is None else _written(pymeshlab, python, Path(folder) / "probe.mlx")
            known = written is not None and written["name"] == name
            if not known:
                known = _known(pymeshlab, name, Path(folder) / "probe.mlx")
            tell({"name": name, "known": known, "written": written})


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
    """Apply a filter by its pymeshlab name with defaults, and read what the history says; None where it refuses."""
    meshes = _scratch(pymeshlab)
    try:
        meshes.apply_filter(python)
        meshes.save_filter_script(str(path))
        element = ElementTree.parse(path).getroot().find("filter")
    except (pymeshlab.PyMeshLabException, RuntimeError, OSError, ElementTree.ParseError):
        return None
    return None if element is None else {"name": element.get("name"), "parameters": [dict(p.attrib) for p in element]}


def _known(pymeshlab, name: str, path: Path) -> bool:
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
    main(*sys.argv[1:])
