"""Numbers, arguments and combinations that make no sense are refused with a sentence, before anything is done."""

import pytest
from support.job_scenes import write_small_scene

import pagas_cl.__main__ as command_line

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_small_scene(tmp_path_factory.mktemp("nonsense") / "scene", 2)


DEPTH, MESH = "--depth-dir {0}/depth_initial", "{0}/mesh_coarse.ply"
CASES = {
    f"tradeoff {{0}} {DEPTH} --sample 0": "views to measure on (sample) is 0, expected 1 or more",
    f"tradeoff {{0}} {DEPTH} --sample -3": "views to measure on (sample) is -3, expected 1 or more",
    f"tradeoff {{0}} {DEPTH} --truth {{0}}/depth_true --repeats 0": "(repeats) is 0, expected 1 or more",
    f"tradeoff {{0}} {DEPTH} --views target --held-out target": "'target.png' is to be measured on (--views, names)",
    f"evaluate {MESH} {MESH} --spacing 0": "Invalid value for '--spacing': 0, expected a number above 0",
    f"evaluate {MESH} {MESH} --max-distance -1": "'--max-distance': -1, expected a number above 0",
    f"evaluate {MESH} {MESH} --max-distance nan": "'--max-distance': nan, expected a number above 0",
    f"evaluate {MESH} {{0}}/depth_true": "is a folder, expected the file of a mesh or of points",
    f"evaluate {MESH} {MESH} --json {{0}}/depth_true": "is a folder, expected the name of a file",
    "evaluate {0}/depth_initial {0}/depth_true --scene {0} --threshold 1": "--threshold goes with a mesh or a point",
    f"evaluate {MESH} {MESH} --held-out target": "--scene is missing",
    f"refine {{0}} {DEPTH} --save-depth d --scheduler foo": "'foo' is no address of a Dask scheduler",
    f"refine {{0}} {DEPTH} --save-depth d --hold-out target context_00": "names all 2 views, so that none is left",
    f"refine {{0}} {DEPTH} --save-depth d --effect foo=on": "setting 'effects.foo'; expected effects.occlusion, ",
    f"refine {{0}} {DEPTH} --save-depth": "--save-depth is empty, expected the name of a file or folder",
    f"refine {{0}} {DEPTH} --report": "--report is empty, expected",
    f"refine {{0}} {DEPTH} --report=": "--report is empty, expected",
    f"refine {{0}} {DEPTH} --save-depth=~/d": "--save-depth is '~/d', a folder called ~, since the shell",
    f"refine {{0}} {DEPTH} --hold-out --save-depth d": "--hold-out has no value, expected one or several",
    f"refine {{0}} --mesh {MESH} --output o.ply --keep-mesh --triangles 99": "--triangles and --keep-mesh do not go",
    f"analyze {{0}} {DEPTH} --json": "--json is empty, expected",
    f"cameras {{0}} {DEPTH} --output": "--output is empty, expected"}


@pytest.mark.parametrize("line", CASES)
def test_it_is_refused_and_leaves_nothing(scene, tmp_path, capsys, monkeypatch, line):
    """Lines that end with an option get an empty word ("$OUT" that is not set)."""
    if "evaluate" in line:
        pytest.importorskip("open3d")
    monkeypatch.chdir(tmp_path)
    arguments = line.format(scene).split()
    assert command_line.run(arguments + [""] * arguments[-1].startswith("--")) == 2
    errors = [text for text in capsys.readouterr().err.splitlines() if text.startswith("pagas-cl: ")]
    assert len(errors) == 1 and CASES[line] in errors[0] and "nearest" not in errors[0] and not list(tmp_path.iterdir())
