"""Benchmarks run at tiny size and write what tables.py reads; docs/benchmarks.md is what the results say."""

import ast
import importlib
import json
import runpy
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from judging import gain, grey_error
from record import record, table
from tables import PAGE, anchor, page, results

from pagas_cl.config.presets import PRESETS
from pagas_cl.errors import DeviceError
from pagas_cl.runtime.device import open_device

HERE = Path(__file__).parent
KEYS = ["title", "measured", "date", "commit", "device", "command", "rows"]
SHORT = "--set pyramid.scales=1 pyramid.steps=5"
# script: its arguments at tiny size, and what it needs besides pagas_cl
SCRIPTS = {
    "agreement.py": (f"--width 64 --kinds clean {SHORT}", ()),
    "agreement_time.py": ("--sizes 64x48 --views 3 --repeats 1", ()),
    "calibration.py": ("--width 64", ("scipy",)),
    "cameras.py": (f"--scenes relief --levels 0.5 --width 80 --contexts 3 {SHORT}", ()),
    "cameras_far.py": ("--width 96 --contexts 3 --amounts 0.5 --seeds 0 --depth good", ()),
    "effects.py": ("--width 64 --contexts 2 --scenes clean", ()),
    "feeds.py": ("--width 64 --context 2 --formats tum", ()),
    "front.py": ("{scenes} {out} front --only preset --names bar", ()),
    "memory.py": ("--size 176 144 --contexts 3 --preset fast", ()),
    "mesh.py": ("sheet --width 64 --preset fast", ("open3d", "pymeshlab")),
    "mesh_times.py": ("--views 3 --size 96 72 --preset fast", ()),
    "planning.py": ("--views 20", ()),
    "prediction.py": ("{scenes} --names bar --views 1 --presets fast", ()),
    "real.py": ("{scenes}/relief --depth-dir {scenes}/relief/depth_initial --share 0.7 " + SHORT, ()),
    "scale.py": ("", ()),
    "scheduling.py": ("--views 10 --workers 2", ("distributed",)),
    "soak.py": ("20", ()),
    "whole.py": ("--views 4 --width 96 --height 72 --times 1", ()),
}
WITHOUT_FIGURES = {"judging.py", "mesh_scenes.py", "picture.py", "record.py", "scenes.py", "settings.py", "stages.py",
                   "tables.py", "test_bench.py"}
BY_THEMSELVES = {"agreement_time.py", "memory.py", "mesh_times.py", "planning.py", "scheduling.py", "soak.py",
                 "whole.py"}
NEEDS_DATA = {
    "middlebury.py": "--share 0.3 --pairs cones",
    "peer.py": f"--scenes sceaux_castle --share 0.05 --presets fast {SHORT}",
}


def script(name: str, *arguments: object) -> None:
    """Run a script as if by itself: in this process, but for those that look at their own or start others."""
    words = [str(HERE / name), *map(str, arguments)]
    if name in BY_THEMSELVES:
        done = subprocess.run([sys.executable, *words], capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr
        return
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", words)
        patch.setattr("sys.path", [*sys.path])
        try:
            runpy.run_path(words[0], run_name="__main__")
        except SystemExit as ended:
            assert not ended.code, ended.code


def checked(file: Path) -> dict:
    result = json.loads(file.read_text(encoding="utf-8"), parse_constant=pytest.fail)
    assert list(result) == KEYS and result["rows"] and all(isinstance(row, dict) for row in result["rows"])
    return result


@pytest.fixture(scope="module")
def device_here():
    try:
        open_device()
    except DeviceError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes")
    script("scenes.py", folder, "--scale", 0.06)
    return folder


def test_page_is_what_the_results_say():
    assert PAGE.read_text(encoding="utf-8") == page(), "run `python tests/bench/tables.py`"


@pytest.mark.parametrize("file", sorted((HERE / "results").glob("*.json")), ids=lambda file: file.stem)
def test_result_has_all_fields(file):
    checked(file)


def test_titles_are_different():
    anchors = [anchor(result["title"]) for result in results()]
    assert len(set(anchors)) == len(anchors)


def test_links_to_the_page_lead_to_sections():
    known = {anchor(result["title"]) for result in results()}
    root = PAGE.parents[1]
    for file in [root / "README.md", *root.glob("docs/*.md")]:
        for part in file.read_text(encoding="utf-8").split("benchmarks.md#")[1:]:
            assert part.split(")")[0] in known, f"{file.name}: {part[:60]}"


def test_record_keeps_columns_and_digits(tmp_path, capsys):
    record("t", "m", "d", [{"a": 1, "b": 0.123456}, {"a": "x", "c": float("nan")}], tmp_path / "r.json")
    assert checked(tmp_path / "r.json")["rows"] == [{"a": 1, "b": 0.1235}, {"a": "x", "c": None}]
    assert "| x |  |  |" in capsys.readouterr().out
    assert table([{"a": 1}]) == "| a |\n| --- |\n| 1 |"


def test_a_gain_has_the_error_that_blocks_give_it():
    rng = np.random.default_rng(1)
    blocks = np.repeat(np.arange(100), 200)
    before = rng.uniform(0, 0.4, 20_000)
    gained, error = gain(before, before - 0.05, blocks)
    assert gained == pytest.approx(0.05) and error < 0.001, "all pixels alike: sure"
    worse = np.where(blocks < 50, 0.1, -0.1)         # half of the blocks gain what the others lose: chance
    gained, error = gain(before, before + worse, blocks)
    assert abs(gained) < 2 * error and error > 0.003


def test_grey_levels_are_compared_after_gain_and_offset():
    warped = np.random.default_rng(0).uniform(0, 255, 5000)
    outliers = np.arange(5000) % 10 == 0
    assert grey_error(np.where(outliers, 250.0, 0.7 * warped + 20), warped) < 0.3
    assert grey_error(0.7 * warped + 20 + 5 * (-1.0) ** np.arange(5000), warped) == pytest.approx(5, rel=0.02)


def test_every_script_is_run_here():
    assert {file.name for file in HERE.glob("*.py")} == {*SCRIPTS, *WITHOUT_FIGURES, *NEEDS_DATA}


@pytest.mark.slow
@pytest.mark.parametrize("name", SCRIPTS)
def test_script_writes_its_figures(name, scenes, tmp_path, device_here):
    arguments, needed = SCRIPTS[name]
    for module in needed:
        pytest.importorskip(module)
    script(name, *arguments.format(scenes=scenes, out=tmp_path / "out").split(), "--json", tmp_path / "r.json")
    result = checked(tmp_path / "r.json")
    assert result["command"].startswith("python ") and name in result["command"] and result["measured"].endswith(".")


@pytest.mark.slow
@pytest.mark.parametrize("name", NEEDS_DATA)
def test_script_of_real_scenes_writes_its_figures(name, data_dir, tmp_path, device_here):
    script(name, data_dir, *NEEDS_DATA[name].split(), "--json", tmp_path / "r.json")
    for file in tmp_path.glob("*.json"):
        checked(file)


@pytest.fixture(scope="module")
def report(tmp_path_factory, device_here):
    path = tmp_path_factory.mktemp("bench") / "bench.json"
    script("stages.py", *"--width 96 --context 2 --repeat 1 --preset balanced paper".split(), "--set",
           "pyramid.scales=1", "pyramid.steps=2", "--json", path)
    return json.loads(path.read_text())["presets"]


@pytest.mark.slow
def test_every_stage_is_there(report):
    balanced, paper = ({stage["name"]: stage for stage in result["stages"]} for result in report)
    assert {"splat_order_free", "ssim_forward", "loss_backward", "gather_gradient", "adam"} <= set(balanced)
    assert {"link_bins", "composite_alpha", "composite_alpha_vjp", "gather_alpha", "plateau"} <= set(paper)
    assert paper["ssim_forward"]["launches"] == 3           # two context views and the target's own


@pytest.mark.slow
def test_figures_hang_together(report):
    for result in report:
        assert result["steps"] == [2] and result["width"] == 96 and result["device_mb"] > 0
        assert result["step_ms"] == pytest.approx(sum(stage["ms"] for stage in result["stages"]))
        for stage in result["stages"]:
            if stage["megabytes"]:
                moved = stage["share"] * result["copy_gb_per_s"] * 1e3 * stage["ms"] * 1e-3
                assert moved == pytest.approx(stage["megabytes"], rel=1e-6)


def test_bytes_are_linear_in_pixels():
    from stages import stage_bytes

    for config in PRESETS.values():
        assert stage_bytes(config, 2000, 1000) == {k: 2 * v for k, v in stage_bytes(config, 1000, 500).items()}


def test_no_script_imports_a_name_that_is_gone():
    for path in sorted(HERE.glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "pagas_cl":
                module = importlib.import_module(node.module)
                for name in (alias.name for alias in node.names):
                    known = hasattr(module, name) or find_spec(f"{node.module}.{name}")
                    assert known, f"{path.name}:{node.lineno} imports {name} from {node.module}"
