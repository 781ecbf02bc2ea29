"""What views are called: a property test over awkward names, in everything that writes, finds or chooses by name."""

import json
import re
import sys
import unicodedata
from pathlib import Path, PureWindowsPath
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from PIL import Image
from support import job_scenes as work
from support.job_scenes import NOT_MEASURED, QUICK, load_small_scene, write_small_scene

import pagas_cl.__main__ as command_line
from pagas_cl.app.commands._given import look
from pagas_cl.app.report import Report
from pagas_cl.app.tradeoffs.case import Setting
from pagas_cl.config.presets import preset
from pagas_cl.errors import InputError
from pagas_cl.jobs import refine_all
from pagas_cl.refine import refine_views
from pagas_cl.result import DepthResult
from pagas_cl.scene.depthmap import SUFFIXES, find_depths, load_depth, save_depth
from pagas_cl.scene.names import OWN, file_stems, flat_stem, place_of
from pagas_cl.scene.readers import camera_file, read_scene
from pagas_cl.scene.view import View

AWKWARD = ["a.png", "a.tif", "A.png", "left/0001.png", "right/0001.png", "cam/a.png", "cam_a.png", "a.png.jpg",
           "frame.0001", "frame.0002", "inputs/b.png", "journal/b.png", "views/b.png", "parts/b.png", "lock.png",
           ".pagas_cl/b.png", ".pagas_cl.png", "a.npz/b.png", "x" * 245 + ".png", "x" * 244 + "y.png", "\u00e9.png",
           "e\u0301.png", "n\nl.png", "q\udce4.png", "sp ace.png", ".hidden.png", "#?%&.png", "<b>.png"]
parts = st.sampled_from([".pagas_cl", "a", "A", "a.npz", "a.png", "x" * 250, "\u00e9", "e\u0301", "\ud800",
                         "inputs", ".a"])
a_name = st.builds(lambda folders, last, kind: "/".join([*folders, last + kind]), st.lists(parts, max_size=2), parts,
                   st.sampled_from(["", ".png", ".tif", ".npz", ".0001"]))


def key(path):
    return unicodedata.normalize("NFC", unicodedata.normalize("NFD", path).casefold())


@settings(deadline=None, max_examples=300, derandomize=True)
@given(st.lists(a_name, unique=True, max_size=8))
@example(AWKWARD)
def test_no_two_views_share_a_file(names):
    """Nor does one's file have the place of another's folder, on file systems that know no capitals either."""
    stems = file_stems(names)
    files = [key(stem + suffix) for stem in stems for suffix in (".npz", ".json")]
    folders = {key(str(parent)) for stem in stems for parent in Path(stem).parents}
    assert len(set(files)) == len(files) and not folders & set(files)
    assert all(len(part.encode(errors="surrogateescape")) + 5 <= 255 for stem in stems for part in Path(stem).parts)
    assert not any(part.casefold().startswith(OWN) for stem in stems for part in Path(stem).parts)
    flat = []
    for name in names:
        flat.append(flat_stem(name, flat))
    assert len({key(stem) for stem in flat}) == len(names) and not any("/" in stem or stem[0] == "." for stem in flat)


def test_the_usual_name_where_nothing_speaks_against_it():
    names = ["left/1.png", "right/1.png", "2.png", "x/3.jpg", "4.png", "4.jpg", "4.png.jpg"]
    stems = file_stems(names)
    assert stems[:6] == ["left/1", "right/1", "2", "3", stems[4], "4.jpg"] and stems[4].startswith("4.png")


def test_names_of_files_on_windows(monkeypatch):
    monkeypatch.setattr("pagas_cl.scene.names.Path", PureWindowsPath)
    assert file_stems(["left\\1.png", "right/1.png", "right/1.jpg"]) == ["left/1", "right/1.png", "right/1.jpg"]
    refused = ["12:30.png", "a?.png", "aux.png", "cam./a.png", "b/a.png"]
    assert file_stems(refused)[:2] == ["12:30", "a?"]
    monkeypatch.setattr(sys, "platform", "win32")
    stems = [stem.partition("~")[0] for stem in file_stems(refused)]
    assert stems == ["12_30.png", "a_.png", "aux.png", "cam._a.png", "b/a"]


@pytest.mark.parametrize("names", [["a.png", "a.png"], ["", ""], ["../a.png"], ["/a.png"], ["a\0.png"], [""]])
def test_names_that_are_indistinguishable_or_lead_outside(names):
    with pytest.raises(InputError):
        file_stems(names)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_small_scene(tmp_path_factory.mktemp("names") / "scene", 4)


def named(scene, names):
    """Views of the small scene and their depths under other names, each depth another one."""
    views, depths = load_small_scene(scene)
    return ([View(views[k % 4].camera, views[k % 4].image, None, name) for k, name in enumerate(names)],
            [depths[k % 4] + np.float32(k) for k in range(len(names))])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:nothing was refined")
def test_every_view_gets_its_own_depth_back(scene, tmp_path):
    """One Camera object serves several photos here, too."""
    views, depths = named(scene, AWKWARD)
    results = refine_all(work.copy_depth, views, depths, range(len(views)), QUICK, folder=tmp_path)
    assert [float((result.depth - depth).max()) for result, depth in zip(results, depths)] == [0] * len(views)
    assert all(result.status.any() and result.name == view.name for result, view in zip(results, views))
    found = find_depths(tmp_path, AWKWARD)
    assert all(np.array_equal(load_depth(file), depth) for file, depth in zip(found, depths))


@pytest.mark.slow
def test_equal_names_are_refused_where_they_name_files(scene, tmp_path):
    views, depths = named(scene, ["a.png", "b.png", "a.png"])
    with pytest.raises(InputError, match="2 views are called 'a.png'"):
        refine_views(views, depths, config=QUICK, folder=tmp_path)


def test_pictures_of_every_view(scene, tmp_path):
    views, depths = named(scene, [*AWKWARD, "a.png"])
    with Report(tmp_path) as page:
        for view, depth in zip(views, depths):
            page.add(view, depth, DepthResult.unrefined(view.camera, depth, "a test"))
    assert len(list(tmp_path.glob("*_photo.jpg"))) == len(views)


def test_a_depth_map_of_two_views(tmp_path):
    names = ["left/0001.png", "right/0001.png", "right/0002.png"]
    for name in ("left/0001", "0002"):
        save_depth(tmp_path / f"{name}.npz", np.ones((2, 2)))
    found = find_depths(tmp_path, names)
    assert [file and str(file.relative_to(tmp_path)) for file in found] == ["left/0001.npz", None, "0002.npz"]
    for suffix in SUFFIXES[:2]:
        (tmp_path / "left/0001.npz").unlink(missing_ok=True)
        (tmp_path / f"0001{suffix}").write_bytes(b"")
        with pytest.raises(InputError, match="could be of view 'left/0001.png' and of 'right/0001.png'"):
            find_depths(tmp_path, names)
        (tmp_path / f"0001{suffix}").unlink()


def test_a_held_out_view_keeps_its_depth_map(tmp_path):
    """Without it, the other one's files could be called as its own are."""
    for name in ("0001", "sub/0001"):
        save_depth(tmp_path / f"{name}.npz", np.ones((2, 2)))
    assert find_depths(tmp_path, ["sub/0001.png"], ["0001.png"]) == [tmp_path / "sub/0001.npz"]
    (tmp_path / "sub/0001.npz").unlink()        # a run that held the first one out has written what is left
    assert find_depths(tmp_path, ["sub/0001.png"], ["0001.png"]) == [tmp_path / "0001.npz"]
    scene, depth = rig(tmp_path / "a", ["0001.png", "sub/0001.png"], []), np.ones((64, 48))
    save_depth(tmp_path / "0001.npz", depth)       # of another shape than the photo: it is refused where it is taken
    save_depth(tmp_path / "sub/0001.npz", load_small_scene(write_small_scene(tmp_path / "plain", 4))[1][1])
    assert command_line.run(["evaluate", str(tmp_path), "--scene", str(scene), "--held-out", "0001.png"]) == 0


def test_a_depth_map_is_called_otherwise_while_photos_are_held_out(tmp_path, caplog):
    """As that of the photo that is held out: it would replace that of an earlier run."""
    found = look(rig(tmp_path, ["0001.png", "sub/0001.png", "2.png", "3.png"], []))
    found.without(["2.png"])
    assert "is called" not in caplog.text
    found.without(["0001.png"])
    assert "of sub/0001.png is called 0001.npz, not sub/0001.npz, while others are held out" in caplog.text


def rig(folder, names, masks):
    """A scene whose photos lie in folders, and masks."""
    views, _ = load_small_scene(write_small_scene(folder, max(4, len(names))))
    for view, name in zip(views, names):
        (folder / "images" / name).parent.mkdir(exist_ok=True)
        Image.fromarray(view.load_image()).save(folder / "images" / name)
    for name in masks:
        (folder / "masks" / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("L", (64, 48), 255).save(folder / "masks" / name)
    camera_file.write(folder, [View(v.camera, folder / "images" / n, None, n) for v, n in zip(views, names)])
    return folder


def test_a_mask_of_two_views(tmp_path):
    names = ["left/0001.png", "right/0001.png", "right/0002.png"]
    scene = read_scene(rig(tmp_path / "a", names, ["left/0001.png", "right/0001.png.png", "0002.png"]))
    assert [str(view.mask.relative_to(tmp_path / "a/masks")) for view in scene.views] == \
        ["left/0001.png", "right/0001.png.png", "0002.png"]
    with pytest.raises(InputError, match="mask .*0001.png' could be of view"):
        read_scene(rig(tmp_path / "b", names, ["0001.png"]))
    with pytest.raises(InputError, match="expected names like left/0001.png or left/0001.png.png"):
        read_scene(rig(tmp_path / "c", names, ["x.png"]))


def test_the_depth_map_that_is_expected_is_one_of_one_view_alone(tmp_path, capsys):
    """What a sentence says to write would be refused, were it 0001.npz; and it names the option that was given."""
    scene = rig(tmp_path / "a", ["left/0001.png", "right/0001.png"], [])
    empty, true = tmp_path / "e", tmp_path / "t"
    empty.mkdir()
    save_depth(true / "right/0001.npz", np.full((48, 64), 4.0))
    for command, expected in [
            (["refine", "--depth-dir", empty, "--save-depth", "d"], f"--depth-dir '{empty}' holds no depth map of"),
            (["refine", "--depth-dir", true, "--save-depth", "d", "--views", "left/0001.png"], "of the view 'left"),
            (["tradeoff", "--depth-dir", true, "--truth", empty], f"--truth '{empty}' holds no depth map of"),
            (["evaluate", empty, true, "--scene", scene], "has a depth map in both")]:
        name, *rest = map(str, command)
        assert command_line.run([name, *([] if name == "evaluate" else [str(scene)]), *rest]) == 2
        said = capsys.readouterr().err.splitlines()[-1]
        assert expected in said and "expected for instance left/0001.npz" in said


def test_truth_of_some_views_is_not_what_is_refined(tmp_path, caplog):
    scene, true = rig(tmp_path / "a", ["left/0001.png", "right/0001.png"], []), tmp_path / "t"
    save_depth(true / "right/0001.npz", np.full((48, 64), 4.0))
    found = look(scene, depth_dir=true)
    assert "they help to refine others, but are not refined: left/0001.png" in caplog.text
    caplog.clear()
    assert [depth is not None for depth in found.with_truth(true, None).depths] == [False, True] and not caplog.text


def test_who_is_meant():
    names = ["a.png", "a.tif", "left/1.png", "right/1.png", "right/2.png", "b"]
    assert [place_of(wanted, names) for wanted in ("a.png", "a.tif", "left/1.png", "2.png", "2", "b")] == \
        [0, 1, 2, 4, 4, 5]
    for wanted in ("a", "1", "1.png"):
        with pytest.raises(InputError, match="could be any of"):
            place_of(wanted, names)
    with pytest.raises(InputError, match="did you mean"):
        place_of("left/2.png", names)
    with pytest.raises(InputError, match="any of cam0/1.png, .*, cam4/1.png and 2 more: give the whole name"):
        place_of("1", [f"cam{k}/1.png" for k in range(7)])


@pytest.mark.slow
def test_the_way_through_the_commands(tmp_path, capsys):
    """A rig with the same names in two folders, and photos that differ in their suffix alone: refine with depth maps
    and pictures, again, evaluate against them; each view meets its own."""
    names = ["left/0001.png", "right/0001.png", "b.png", "b.tif"]
    scene, out = rig(tmp_path / "scene", names, []), tmp_path / "out"
    views, depths = read_scene(scene).views, load_small_scene(write_small_scene(tmp_path / "plain", 4))[1]
    for name, depth in zip(file_stems(names), depths):
        save_depth(tmp_path / f"depth/{name}.npz", depth)
    refine = ["refine", str(scene), "--depth-dir", str(tmp_path / "depth"), "--save-depth", str(out), "--quiet",
              "--set", "pyramid.steps=3", *NOT_MEASURED]
    assert command_line.run([*refine, "--report", str(tmp_path / "report")]) == 0
    assert sorted(str(file.relative_to(out)) for file in out.rglob("*.npz") if OWN not in file.parts) == \
        ["b.png.npz", "b.tif.npz", "left/0001.npz", "right/0001.npz"]
    alone = refine_views(views, depths, config=QUICK.with_settings(context__number=5, effects__agreement="auto"))
    assert all(np.array_equal(load_depth(file), result.depth)
               for file, result in zip(find_depths(out, names), alone))
    assert len(list((tmp_path / "report").glob("*_change.png"))) == 4
    assert command_line.run([*refine, "--views", "0001"]) == 2 and "could be any of" in capsys.readouterr().err
    capsys.readouterr()
    assert command_line.run(["evaluate", str(out), str(out), "--scene", str(scene)]) == 0
    shown = capsys.readouterr().out
    assert all(name in shown for name in names)


HOSTILE = ["a.png", "cam/a.png", "n\nl.png", "<b>#?%& ' \".png", "x" * 245 + ".png", "q\udce4.png"]
OBEYED = "n\n\x1b]0;t\x07\rl\x9b1m\u202e[red].png"      # by a terminal


@pytest.mark.slow
def test_awkward_names_through_every_command_that_writes(tmp_path, capsys, monkeypatch):
    """And nothing in a name is obeyed by the terminal, or begins a line there."""
    names = [OBEYED if "\n" in name else name for name in HOSTILE]
    pycolmap = pytest.importorskip("pycolmap")
    short = Setting("short", preset("balanced").with_settings(pyramid__steps=(2,)))
    for stream in (sys.stdout, sys.stderr):        # as in a process of our own
        stream.reconfigure(errors="backslashreplace")
    monkeypatch.setattr("pagas_cl.app.tradeoffs.study.front_plan", lambda: [short])
    monkeypatch.setattr("pagas_cl.app.tradeoffs.study.Guess", lambda *_: Mock(seconds=lambda *_: 0.0))
    scene, out = rig(tmp_path / "scene", names, []), tmp_path / "out"
    for stem, depth in zip(file_stems(names), load_small_scene(write_small_scene(tmp_path / "plain", 6))[1]):
        save_depth(tmp_path / f"depth/{stem}.npz", depth)

    def run(command, *more, status=0, place=scene):
        assert command_line.run([command, str(place), "--depth-dir", str(tmp_path / "depth"), "--quiet",
                                 *map(str, more)]) == status

    run("refine", "--save-depth", out, "--report", out / "page", "--set", "pyramid.steps=2", *NOT_MEASURED,
        "agreement=off")
    shown = json.loads((out / "page/report.json").read_text())
    assert [row["view"] for row in shown["views"]] == names and len(list((out / "page").glob("*_change.png"))) == 6
    run("analyze", "--no-costs", "--json", out / "a.json")
    assert [view["view"] for view in json.loads((out / "a.json").read_text())["views"]] == names
    run("tradeoff", "--report", out / "study", "--sample", "6")
    study = json.loads((out / "study/tradeoff.json").read_text())
    assert list(study["initial"]) == file_stems(names) == [record["case"] for record in study["records"]]
    assert command_line.run(["evaluate", str(out), str(tmp_path / "depth"), "--scene", str(scene), "--json",
                             str(out / "e.json")]) == 0
    assert [name.partition(": ")[0] for name in json.loads((out / "e.json").read_text())["figures"]] == names
    from_depths = ("--depth-dir", str(tmp_path / "depth"))
    assert command_line.run(["check", str(scene), *from_depths]) in (0, 2)
    refine = ["refine", str(scene), *from_depths, "--report", str(out / "one")]
    assert command_line.run([*refine, "--views", "b", "--hold-out", OBEYED]) == 2 == command_line.run(
        [*refine, "--views", "n"])
    shown = "".join(capsys.readouterr())
    run("cameras", "--output", out / "cameras", status=2)
    shown += (refused := capsys.readouterr().err)
    assert "has a name that is no UTF-8" in refused and not (out / "cameras").exists()
    camera_file.write(scene, [view for view in read_scene(scene).views if view.name != names[-1]])
    run("cameras", "--output", out / "cameras")
    model = pycolmap.Reconstruction(str(out / "cameras/sparse/0"))
    assert [model.images[k].name for k in sorted(model.images)] == names[:-1]
    shown += "".join(capsys.readouterr())
    assert shown.count(r"n\n\x1b]0;t\x07\rl\x9b1m\u202e[red].png") > 2
    assert not re.search("[\0-\t\v-\x1f\x7f-\x9f\u202e]|^ *(\\\\x1b|l\\\\x9b)", shown, re.M)


@pytest.mark.slow
def test_awkward_names_in_a_project(tmp_path, capsys):
    pytest.importorskip("pymeshlab")
    scene = rig(tmp_path / "scene", HOSTILE, [])
    (tmp_path / "s.mlx").write_text('<!DOCTYPE FilterScript><FilterScript><filter name="Invert Faces Orientation"/>'
                                    "</FilterScript>")
    command = ["script", str(tmp_path / "s.mlx"), str(scene), "--mesh", str(scene / "mesh_coarse.ply"), "--output",
               str(tmp_path / "p.mlp"), "--quiet"]
    assert command_line.run(command) == 2 and "cannot stand in a MeshLab project" in capsys.readouterr().err
    assert not list(tmp_path.glob("p*"))
    camera_file.write(scene, [view for view in read_scene(scene).views if view.name != HOSTILE[-1]])
    assert command_line.run(command) == 0
    assert [view.name for view in read_scene(tmp_path / "p.mlp", "meshlab", flavour="meshlab").views] == HOSTILE[:-1]
