"""The bench runs at tiny size and its figures hang together; it never asserts a time."""

import ast
import importlib
import json
from importlib.util import find_spec
from pathlib import Path

import pytest

from pagas_cl.config.presets import PRESETS
from pagas_cl.errors import DeviceError
from pagas_cl.runtime.device import open_device

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    import stages

    try:
        open_device()
    except DeviceError as error:
        pytest.skip(str(error))
    path = tmp_path_factory.mktemp("bench") / "bench.json"
    arguments = ["--width", "96", "--context", "2", "--repeat", "1", "--preset", "balanced", "paper",
                 "--set", "pyramid.scales=1", "pyramid.steps=2", "--json", str(path)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", ["stages.py", *arguments])
        stages.main()
    return json.loads(path.read_text())["presets"]


def test_every_stage_is_there(report):
    balanced, paper = ({stage["name"]: stage for stage in result["stages"]} for result in report)
    assert {"splat_order_free", "ssim_forward", "loss_backward", "gather_gradient", "adam"} <= set(balanced)
    assert {"link_bins", "composite_alpha", "composite_alpha_vjp", "gather_alpha", "plateau"} <= set(paper)
    assert paper["ssim_forward"]["launches"] == 3           # two context views and the target's own


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


def test_no_script_asks_for_a_name_that_is_gone():
    for path in sorted(Path(__file__).parent.glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "pagas_cl":
                module = importlib.import_module(node.module)
                for name in (alias.name for alias in node.names):
                    known = hasattr(module, name) or find_spec(f"{node.module}.{name}")
                    assert known, f"{path.name}:{node.lineno} asks {node.module} for {name}"


def test_memory_page_runs(capsys, monkeypatch):
    import memory

    monkeypatch.setattr("sys.argv", ["memory.py", "--size", "176", "144", "--contexts", "3", "--preset", "fast"])
    assert memory.main() == 0
    assert capsys.readouterr().out.rstrip().endswith("the same bytes")


def test_exponent_of_linear_times_is_one():
    from scaling import fitted_exponent

    assert fitted_exponent([1, 2, 4, 8], [3, 6, 12, 24]) == pytest.approx(1)
