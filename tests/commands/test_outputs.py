"""No command writes over what it reads, nor, without --overwrite, over a file that pagas_cl has not written: each
command with each option that names a place to write to."""

import inspect
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import get_type_hints

import pytest
from support.here import command
from support.job_scenes import NOT_MEASURED, write_small_scene

import pagas_cl.__main__ as command_line
from pagas_cl.app.commands._outputs import check_outputs
from pagas_cl.app.tradeoffs import study
from pagas_cl.app.tradeoffs.case import Setting
from pagas_cl.config.presets import preset
from pagas_cl.errors import InputError, log
from pagas_cl.scene.own_files import TEXT_MARK, json_text

pytestmark = pytest.mark.slow

PLACES = ("--output", "--json", "--report", "--save-depth", "--save-script")
IN_OTHER_TESTS = ("script",)     # its rows: tests/filters
SHORT = ("--set", "pyramid.steps=2", "--context", "2", "--views", "target", *NOT_MEASURED)
FOREIGN = b"somebody's"
SHORT_PLAN = [Setting("short", preset("balanced").with_settings(pyramid__steps=(2,)))]

# command and option -> what else it is given, {0}: the scene, {1}: the place
LINES = {
    ("refine", "--output"): "refine {0} --mesh {0}/mesh_coarse.ply --output {1} " + " ".join(SHORT),
    ("refine", "--save-depth"): "refine {0} --depth-dir {0}/depth_initial --save-depth {1} " + " ".join(SHORT),
    ("refine", "--report"): "refine {0} --depth-dir {0}/depth_initial --report {1} " + " ".join(SHORT),
    ("analyze", "--json"): "analyze {0} --depth-dir {0}/depth_initial --views target --no-costs --json {1}",
    ("evaluate", "--json"): "evaluate {0}/depth_initial {0}/depth_true --scene {0} --json {1}",
    ("tradeoff", "--report"): "tradeoff {0} --depth-dir {0}/depth_initial --sample 1 --report {1}",
    ("cameras", "--output"): "cameras {0} --depth-dir {0}/depth_initial --output {1}",
    ("demo", "--output"): "demo --width 64 --context 2 --output {1}",
}
# the places of inputs that each could be given to write to; the last of each is read through a link
INPUTS = {
    ("refine", "--output"): ["mesh_coarse.ply", "linked.ply"],
    ("refine", "--save-depth"): [".", "images", "depth_initial", "depth_true", "linked"],
    ("refine", "--report"): [".", "images", "depth_initial", "depth_true", "linked"],
    ("analyze", "--json"): ["images/target.png", "cameras.json", "depth_initial/target.npz", "linked.json"],
    ("evaluate", "--json"): ["images/target.png", "cameras.json", "depth_initial/target.npz", "linked.json"],
    ("tradeoff", "--report"): [".", "images", "depth_initial", "linked"],
    ("cameras", "--output"): [".", "images", "depth_initial", "linked"],
    ("demo", "--output"): [],
}
# below the place: a foreign file that the command would replace
TAKEN = {
    ("refine", "--output"): "", ("refine", "--save-depth"): "target.npz", ("refine", "--report"): "target_change.png",
    ("analyze", "--json"): "", ("evaluate", "--json"): "",
    ("tradeoff", "--report"): "tradeoff.png", ("cameras", "--output"): "cameras_report.json",
    ("demo", "--output"): "mesh_refined.ply",
}
NAMES = {"--output": "out.ply", "--json": "out.json"}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A scene with links to a file and a folder of its own."""
    scene = write_small_scene(tmp_path_factory.mktemp("outputs") / "scene", 6)
    (scene / "linked.json").symlink_to("cameras.json")
    (scene / "linked").symlink_to("images")
    return scene


@pytest.fixture
def scene(made, tmp_path):
    scene = shutil.copytree(made, tmp_path / "scene", symlinks=True)
    os.link(scene / "mesh_coarse.ply", scene / "linked.ply")
    return scene


def run(*arguments):
    """The command; `tradeoff` with a plan of one setting."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study, "front_plan", lambda: SHORT_PLAN)
        return command(*arguments)


def content(folder: Path) -> dict:
    return {str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
            for path in sorted(folder.rglob("*"))}


def refused(done, place) -> None:
    """With status 2, one sentence, the last line, which names the place."""
    last = done.stderr.splitlines()[-1]
    assert done.returncode == 2, done.stderr
    assert last.startswith("pagas-cl: ") and str(place) in last and "Traceback" not in done.stderr


def options_of(command: str) -> dict:
    """Name of each option of a command -> its type."""
    function = command_line._module(command).command
    hints = get_type_hints(function)
    return {parameter.default.param_decls[0]: hints[name] for name, parameter in
            inspect.signature(function).parameters.items() if getattr(parameter.default, "param_decls", None)}


def test_every_place_that_a_command_writes_to_has_a_row():
    found = {(command, option) for command in command_line.command_names() for option, kind in
             options_of(command).items() if option in PLACES and kind is Path and command not in IN_OTHER_TESTS}
    assert found == LINES.keys() == INPUTS.keys() == TAKEN.keys()
    assert all({"--overwrite", "--quiet"} <= options_of(command).keys() for command, _ in LINES)
    assert all("--quiet" in options_of(name) for name in command_line.command_names())


@pytest.mark.parametrize("row", [(*key, name) for key, names in INPUTS.items() for name in names])
def test_an_input_is_not_replaced(scene, tmp_path, row):
    """Not with --overwrite, either."""
    command, option, name = row
    place = scene / name
    before = content(tmp_path)
    arguments = LINES[command, option].format(scene, place).split()
    refused(run(*arguments, "--overwrite"), place)
    assert content(tmp_path) == before


@pytest.mark.parametrize("row", LINES)
def test_a_foreign_file_is_replaced_with_overwrite_alone(scene, tmp_path, row):
    """And one of our own without it."""
    if row[0] == "cameras":
        pytest.importorskip("pycolmap")
    place = tmp_path / "there" / NAMES.get(row[1] if row != ("cameras", "--output") != row else "", "out")
    place = place if not TAKEN[row] else tmp_path / "there" / "out"
    taken = place / TAKEN[row] if TAKEN[row] else place
    taken.parent.mkdir(parents=True)
    taken.write_bytes(FOREIGN)
    before = content(tmp_path)
    arguments = LINES[row].format(scene, place).split()
    refused(run(*arguments), taken)
    assert content(tmp_path) == before
    done = run(*arguments, "--overwrite", "--quiet")
    assert done.returncode == 0, done.stderr
    assert taken.read_bytes() != FOREIGN or row == ("tradeoff", "--report")      # without matplotlib no plot
    assert content(scene) == {name.removeprefix("scene/"): data for name, data in before.items()
                              if name.startswith("scene/")}
    assert run(*arguments, "--quiet").returncode == 0


def test_the_mesh_that_a_scene_itself_has_is_not_replaced(scene, tmp_path):
    """Found without --mesh: it is known once the scene was looked at."""
    for name in ("depth_initial", "depth_true", "linked", "linked.ply"):
        shutil.rmtree(scene / name) if (scene / name).is_dir() and not (scene / name).is_symlink() else \
            (scene / name).unlink()
    mesh, before = scene / "mesh_coarse.ply", content(tmp_path)
    refused(run("refine", scene, "--output", mesh, "--overwrite", *SHORT), mesh)
    assert content(tmp_path) == before


def test_two_outputs_in_one_place(scene, tmp_path):
    page = tmp_path / "page"
    refused(run("refine", scene, "--depth-dir", scene / "depth_initial", "--save-depth", page, "--report", page,
                *SHORT), page)
    assert not page.exists()


def test_a_file_that_is_there_is_known_by_its_mark(tmp_path):
    own, text, foreign, pipe = (tmp_path / name for name in ("own.json", "s.mlx", "foreign.json", "pipe"))
    own.write_text(json_text("any", {"a": float("nan")}))
    text.write_text(f"<!-- {TEXT_MARK} 1 --><FilterScript/>")
    foreign.write_text('{"a": "pagas_cl"}')
    os.mkfifo(pipe)
    check_outputs([("--json", own), ("--save-script", text), ("--output", None)], [], {}, False)
    with pytest.raises(InputError, match="foreign.json' is there and was not written by pagas_cl"):
        check_outputs([("--json", foreign)], [], {}, False)
    check_outputs([("--json", foreign)], [], {}, True)
    for overwrite in (False, True):
        with pytest.raises(InputError, match="is no regular file"):
            check_outputs([("--json", pipe)], [], {}, overwrite)
        with pytest.raises(InputError, match="foreign.json' is a file of SCENE"):
            check_outputs([("--json", foreign)], [], {"SCENE": tmp_path}, overwrite)


def test_words_at_the_end_of_a_text_are_no_mark(tmp_path):
    notes = tmp_path / "notes.html"
    notes.write_text(5000 * "." + f"\nabout a mesh {TEXT_MARK}\n")
    with pytest.raises(InputError, match="notes.html' is there and was not written by pagas_cl"):
        check_outputs([("--save-script", notes)], [], {}, False)


def test_figures_are_json_of_one_form(scene, tmp_path):
    """Also where they hold what is no number."""
    for row in (("analyze", "--json"), ("evaluate", "--json")):
        path = tmp_path / f"{row[0]}.json"
        assert run(*LINES[row].format(scene, path).split()).returncode == 0
        written = json.loads(path.read_text(), parse_constant=pytest.fail)
        assert written["pagas_cl"] and written["command"] == row[0]
    done = run("check", scene, "--mesh", scene / "mesh_coarse.ply", "--json", "--quiet")
    written = json.loads(done.stdout, parse_constant=pytest.fail)
    assert written["command"] == "check" and done.stderr.count("INFO") == 0


# -- models of cameras -----------------------------------------------------------------------------------------------


def test_no_model_is_mixed_with_another_one(scene, tmp_path):
    pytest.importorskip("pycolmap")
    out = tmp_path / "out"
    arguments = LINES["cameras", "--output"].format(scene, out).split()
    assert run(*arguments).returncode == 0
    names = {path.name for path in (out / "sparse/0").iterdir()}
    foreign = out / "sparse/0" / ("cameras.txt" if "cameras.bin" in names else "cameras.bin")
    foreign.write_bytes(FOREIGN)
    before = content(tmp_path)
    refused(run(*arguments), foreign)
    assert content(tmp_path) == before
    done = run(*arguments, "--overwrite")
    assert done.returncode == 0 and {path.name for path in (out / "sparse/0").iterdir()} == names
    assert "Next: pagas-cl refine" in done.stdout and "has the cameras as SCENE has them" in done.stdout


# -- what cannot end well is refused before anything is written --------------------------------------------------------


NUMBERS = [(command, option) for command in command_line.command_names() for option, kind in
           options_of(command).items() if kind in (float, list[float])]


@pytest.mark.parametrize("command, option", NUMBERS)
def test_numbers_that_are_none_are_refused(capsys, command, option):
    """While options are read: no file need be there."""
    for value in ("inf", "-inf", "nan", "-1", "x", *(["0"] if option != "--bar" else [])):
        assert command_line.run([command, f"{option}={value}"]) == 2
        last = capsys.readouterr().err.splitlines()[-1]
        assert f"Invalid value for '{option}': " in last and value in last


@pytest.mark.parametrize("row, arguments", [(("tradeoff", "--report"), ["--budget", "0.0001"]),
                                        (("refine", "--output"), ["--fuse", "--memory", "0.01"]),
                                        (("refine", "--save-depth"), ["--set", "solver.rate=inf"]),
                                        (("refine", "--save-depth"), ["--set", "solver.rate=nan"])])
def test_what_cannot_be_done_leaves_nothing(scene, tmp_path, row, arguments):
    before, place = content(tmp_path), tmp_path / "new" / NAMES.get(row[1], "out")
    done = run(*LINES[row].format(scene, place).split(), *arguments)
    assert done.returncode == 2 and done.stderr.splitlines()[-1].startswith("pagas-cl: "), done.stderr
    assert content(tmp_path) == before and "refine: 1 of" not in done.stderr


def test_names_that_no_file_can_have_are_refused_before_the_mesh_is_drawn(scene, tmp_path, monkeypatch, capsys):
    entries = json.loads((scene / "cameras.json").read_text())
    shutil.copy(scene / "images/target.png", tmp_path / "target.png")
    for entry in entries["views"]:
        entry["image"] = "../../target.png" if entry["image"] == "target.png" else entry["image"]
    (scene / "cameras.json").write_text(json.dumps(entries))
    before = content(tmp_path)
    monkeypatch.setattr("pagas_cl.refine.initial_depths", pytest.fail)
    for arguments in (["refine", str(scene), "--output", str(tmp_path / "a.ply")],
                  ["cameras", str(scene), "--output", str(tmp_path / "c")]):
        assert command_line.run([*arguments, "--mesh", str(scene / "mesh_coarse.ply"), "--outside"]) == 2
        assert "expected a relative name without '..'" in capsys.readouterr().err
    assert content(tmp_path) == before


def test_memory_that_changes_nothing_is_said(scene, tmp_path):
    done = run(*LINES["refine", "--save-depth"].format(scene, tmp_path / "d").split(), "--memory", "50", "--quiet")
    assert done.returncode == 0 and "--memory 50 changes nothing" in done.stderr


# -- statuses, and what is said last -----------------------------------------------------------------------------------


def test_a_full_disk_has_one_status(scene, tmp_path, monkeypatch, capsys):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pagas_cl.system.files._rename", full)
    for row in (("analyze", "--json"), ("evaluate", "--json"), ("refine", "--save-depth"), ("refine", "--output")):
        place = tmp_path / NAMES.get(row[1], "out")
        assert command_line.run(LINES[row].format(scene, place).split()) == 1, row
        last = capsys.readouterr().err.splitlines()[-1]
        assert last.startswith("pagas-cl: ") and "No space left" in last and not place.is_file()


@pytest.mark.parametrize("error", [InputError("the cause"), KeyboardInterrupt()])
def test_the_cause_is_the_last_line(monkeypatch, capsys, error):
    def fails(_):
        for number in range(20):
            log.warning("warning %s", number)
        raise error

    monkeypatch.setattr(command_line, "_run", fails)
    command_line.run([])
    written = capsys.readouterr().err.splitlines()
    assert any("15 more warnings" in line for line in written)
    assert written[-1] in ("pagas-cl: the cause", "pagas-cl: interrupted")


@pytest.mark.parametrize("number, status", [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_signal_has_its_status_and_leaves_no_empty_folder(scene, tmp_path, number, status):
    out = tmp_path / "out"
    arguments = LINES["refine", "--save-depth"].format(scene, out).split()
    process = subprocess.Popen([sys.executable, "-m", "pagas_cl", *arguments, "--set", "pyramid.steps=20000"],
                               stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 60
    while not list(out.glob(".pagas_cl/journal/*.txt")) and time.monotonic() < deadline and process.poll() is None:
        time.sleep(0.05)
    process.send_signal(number)
    written = process.communicate(timeout=60)[1]
    assert process.returncode == status and written.splitlines()[-1].startswith("pagas-cl: interrupted; "), written
    assert not [path for path in out.rglob("*") if path.is_dir() and not any(path.iterdir())]


def test_quiet_runs_say_nothing(scene, tmp_path):
    for row in (("refine", "--output"), ("analyze", "--json"), ("evaluate", "--json")):
        done = run(*LINES[row].format(scene, tmp_path / NAMES[row[1]]).split(), "--quiet")
        assert done.returncode == 0 and all(line.startswith("WARNING") for line in done.stderr.splitlines())


@pytest.mark.parametrize("more, line", [(["--memory", "50"], "50 MB (as given), room for 111,111 triangles"),
                                       ([], "(at most half of what is free), room for ")])
def test_memory_for_the_mesh_is_said_before_the_work(scene, tmp_path, more, line):
    done = run(*LINES["refine", "--output"].format(scene, tmp_path / "a.ply").split(), *more)
    lines = done.stderr.splitlines()
    said = [number for number, text in enumerate(lines) if "memory for the mesh: " in text and line in text]
    assert done.returncode == 0 and len(said) == 1
    assert said[0] < next(number for number, text in enumerate(lines) if "refine: " in text)
