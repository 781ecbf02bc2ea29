"""What editors and type checkers see of `import pagas_cl`, whose names are loaded when they are first used."""

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import pagas_cl

ROOT = Path(__file__).resolve().parent.parent
# Public callables: a parameter that their signature must show.
SIGNATURES = {"refine_mesh": "mesh", "refine_depth": "target", "refine_views": "views", "Camera": "world_to_camera",
              "View": "camera", "read_scene": "folder", "Config": "solver", "preset": "name", "load_depth": "path",
              "save_depth": "depth", "find_depth": "image_name", "check_cameras": "mesh", "tradeoff": "views"}


def imported_for_checkers():
    """{module: names} of the imports under TYPE_CHECKING."""
    tree = ast.parse((ROOT / "pagas_cl" / "__init__.py").read_text(encoding="utf-8"))
    block = next(node for node in tree.body if isinstance(node, ast.If) and node.test.id == "TYPE_CHECKING")
    return {node.module: [alias.name for alias in node.names] for node in block.body}


def test_names_are_the_same_at_run_time_and_for_checkers():
    there = {f"pagas_cl.{module}": names for module, names in pagas_cl._HOME.items()}
    assert imported_for_checkers() == there
    assert pagas_cl.__all__ == sorted(name for names in there.values() for name in names)
    assert set(pagas_cl.__all__) <= set(dir(pagas_cl))


def test_an_editor_completes_every_name():
    jedi = pytest.importorskip("jedi")
    offered = jedi.Script("import pagas_cl\npagas_cl.").complete(2, len("pagas_cl."))
    assert set(pagas_cl.__all__) <= {name.name for name in offered}
    begun = jedi.Script("import pagas_cl\npagas_cl.refine_").complete(2, len("pagas_cl.refine_"))
    assert {"refine_cameras", "refine_depth", "refine_mesh", "refine_views"} == {name.name for name in begun}


@pytest.mark.parametrize("name", SIGNATURES)
def test_an_editor_shows_signature_and_docstring(name):
    jedi = pytest.importorskip("jedi")
    code = f"import pagas_cl\npagas_cl.{name}("
    script = jedi.Script(code)
    signatures = script.get_signatures(2, len(code.splitlines()[1]))
    assert len(signatures) == 1
    assert SIGNATURES[name] in [parameter.name for parameter in signatures[0].params]
    assert signatures[0].docstring(raw=True).strip()


def test_an_editor_follows_what_comes_back():
    jedi = pytest.importorskip("jedi")
    code = "import pagas_cl\nscene = pagas_cl.read_scene('.')\nresult = pagas_cl.refine_depth(scene.views[0], [], 0)\n"
    offered = {name.name for name in jedi.Script(code + "result.").complete(4, len("result."))}
    assert {"depth", "status", "confidence", "normals", "reason"} <= offered


@pytest.mark.slow
def test_a_type_checker_finds_the_names(tmp_path):
    """As a project of a user would be checked, in strict mode: every name has a type, and mistakes are found."""
    pytest.importorskip("mypy")
    names = pagas_cl.__all__
    program = tmp_path / "program.py"
    program.write_text("import pagas_cl\n" + "\n".join(f"reveal_type(pagas_cl.{name})" for name in names)
                       + "\npagas_cl.refine_mesh()\npagas_cl.preset(1)\npagas_cl.refine_mash\n")
    (tmp_path / "mypy.ini").write_text("[mypy]\nignore_missing_imports = True\n"
                                       "[mypy-pagas_cl.*]\nignore_errors = True\n")
    # without other packages, which take most of the time and none of whose types a name here is
    done = subprocess.run([sys.executable, "-m", "mypy", "--strict", "--no-site-packages", "--cache-dir",
                           str(tmp_path / "cache"), "program.py"], cwd=tmp_path,
                          env={**os.environ, "MYPYPATH": str(ROOT)}, capture_output=True, text=True)
    lines = done.stdout.splitlines()
    revealed = [line.partition("Revealed type is ")[2] for line in lines if "Revealed type" in line]
    assert len(revealed) == len(names), done.stdout + done.stderr
    unknown = [name for name, kind in zip(names, revealed) if not re.match(r'"(def|Overload)', kind)]
    assert not unknown
    errors = [line for line in lines if "error:" in line]
    assert [error.rpartition("[")[2] for error in errors] == ["call-arg]", "arg-type]", "attr-defined]"], done.stdout
