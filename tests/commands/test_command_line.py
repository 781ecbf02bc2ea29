"""The command line: what it writes, its exit statuses, and one sentence for everything that goes wrong."""

import json
import shutil
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

import pagas_cl
import pagas_cl.__main__ as command_line
from pagas_cl.app.commands._process import typed
from pagas_cl.config.presets import build_config
from pagas_cl.errors import DeviceError, InputError, MissingExtraError, NoDeviceError
from pagas_cl.scene.depthmap import load_depth, save_depth
from pagas_cl.scene.meshes.kinds import to_surface
from pagas_cl.scene.readers import read_scene

QUICK = ["--quiet", "--no-align", "--set", "pyramid.steps=3"]


@pytest.fixture(scope="module")
def made_scene(tmp_path_factory):
    from support.scenes import relief_scene
    from support.synthetic.scene import write_scene

    return write_scene(relief_scene(64, 48, 2, held_out=0), tmp_path_factory.mktemp("synthetic") / "scene")


@pytest.fixture
def scene(made_scene, tmp_path):
    """A copy that a test may spoil."""
    return shutil.copytree(made_scene, tmp_path / "scene")


@pytest.fixture
def fails(capsys):
    """Runs the command line, which must fail with `status`; returns its one sentence."""
    def run(status, *arguments):
        capsys.readouterr()
        assert command_line.run([str(word) for word in arguments]) == status
        sentence = [line for line in capsys.readouterr().err.splitlines() if line.startswith("pagas-cl: ")]
        assert len(sentence) == 1
        return sentence[0]

    return run


def refine(scene, *more):
    return ["refine", str(scene), *QUICK, *map(str, more)]


def maps_and_cameras(folder):
    """What --save-depth left: depth maps by name, and cameras by photo."""
    entries = json.loads((folder / "cameras.json").read_text())["views"]
    return ({path.stem: load_depth(path) for path in folder.glob("*.npz")},
            {entry["image"]: np.array(entry["world_to_camera"]) for entry in entries})


# -- what it does ------------------------------------------------------------------------------------------------


def test_the_cameras_next_to_depth_maps_are_theirs(scene, tmp_path):
    """Also where a run replaces some of them, or refines cameras no more."""
    out, depths, turned = tmp_path / "out", ["--depth-dir", scene / "depth_initial"], tmp_path / "turned"
    assert command_line.run(refine(scene, *depths, "--save-depth", out)) == 0
    given = {view.name: view.camera.world_to_camera for view in read_scene(scene).views}
    _, cameras = maps_and_cameras(out)
    assert cameras.keys() == given.keys() and all(np.array_equal(cameras[name], given[name]) for name in given)
    entries = json.loads((scene / "cameras.json").read_text())
    for entry in entries["views"]:
        entry["world_to_camera"][0][3] += 1.0
    shutil.copytree(scene, turned)
    (turned / "cameras.json").write_text(json.dumps(entries))
    assert command_line.run(refine(turned, *depths, "--save-depth", out, "--views", "target.png", "--overwrite")) == 0
    _, cameras = maps_and_cameras(out)
    assert {name: cameras[name][0, 3] - given[name][0, 3] for name in given} == pytest.approx(
        {name: float(name == "target.png") for name in given})
    (out / "context_00.npz").unlink()       # nor those of maps that are not there
    assert command_line.run(refine(scene, *depths, "--save-depth", out, "--views", "target.png", "--overwrite")) == 0
    assert maps_and_cameras(out)[1].keys() == given.keys() - {"context_00.png"}


def test_a_depth_scale_is_that_of_png_files(scene, tmp_path, capsys):
    """Depth maps of pagas_cl are in scene units, whatever those are in that they are compared with."""
    (tmp_path / "millimetres").mkdir()
    for path in (scene / "depth_true").glob("*.npz"):
        Image.fromarray(np.rint(50 * load_depth(path)).astype(np.uint16)).save(
            tmp_path / "millimetres" / f"{path.stem}.png")
    figures = []
    for truth, more in ((scene / "depth_true", ()), (tmp_path / "millimetres", ("--depth-scale", "50"))):
        capsys.readouterr()
        assert command_line.run(["evaluate", str(scene / "depth_initial"), str(truth), "--scene", str(scene), *more,
                                 "--json", str(tmp_path / "figures.json"), "--overwrite"]) == 0
        table = json.loads((tmp_path / "figures.json").read_text())["figures"]
        figures.append([rows["smooth"]["median"] for rows in table.values()])
    assert figures[0] == pytest.approx(figures[1], rel=0.05)


def test_the_mesh_of_the_scene_is_refined_as_a_named_one(scene, tmp_path):
    shutil.rmtree(scene / "depth_initial")
    out = tmp_path / "out.ply"
    assert command_line.run(refine(scene, "--output", out, "--triangles", "300")) == 0
    assert len(to_surface(out).faces) == pytest.approx(300, rel=0.02)


def test_options_that_would_change_nothing_are_refused(scene, tmp_path, fails):
    mesh, out = ["--mesh", scene / "mesh_coarse.ply"], tmp_path / "out.ply"
    assert "cannot hold colours" in fails(2, *refine(scene, *mesh, "--output", tmp_path / "out.stl", "--color"))
    assert "--depth-scale is the unit" in fails(2, *refine(scene, *mesh, "--output", out, "--depth-scale", "1000"))
    shutil.rmtree(scene / "depth_initial")
    assert "--depth-scale is the unit" in fails(2, *refine(scene, "--output", out, "--depth-scale", "1000"))
    for option in ("--fuse", "--keep-mesh", "--color", "--subdivide=2", "--triangles=300"):
        sentence = fails(2, *refine(scene, *mesh, "--save-depth", tmp_path / "d", option))
        assert f"{option.split('=')[0]} is for the mesh" in sentence
    assert "--allow-loss goes with" in fails(2, *refine(scene, *mesh, "--output", out, "--allow-loss"))
    with pytest.raises(InputError, match="no place for colours"):
        pagas_cl.refine_mesh((np.eye(3), np.array([[0, 1, 2]])), [], [], color=True)


def test_one_view_alone_moves_no_vertex_which_is_no_fault_of_cameras(scene, tmp_path, capsys):
    assert command_line.run(refine(scene, "--mesh", scene / "mesh_coarse.ply", "--output", tmp_path / "fine.ply",
                                   "--views", "target", "--preset", "fast")) == 0
    said = capsys.readouterr().err
    assert "(refined: 1 of 1); refine more views, or fuse" in said and "pagas-cl check" not in said


def test_it_is_said_that_fast_does_not_check_cameras(scene, tmp_path, capsys):
    assert command_line.run(["refine", str(scene), "--depth-dir", str(scene / "depth_initial"), "--save-depth",
                             str(tmp_path / "out"), "--preset", "fast"]) == 0
    assert "cameras: taken as they are, not checked" in capsys.readouterr().err


def test_refine_from_depth_maps(scene, tmp_path):
    out = tmp_path / "out"
    assert command_line.run(refine(scene, "--depth-dir", scene / "depth_initial", "--save-depth", out,
                                   "--report", tmp_path / "page", "--context", 1)) == 0
    written = sorted(path.name for path in out.glob("*.npz"))
    assert written == ["context_00.npz", "context_01.npz", "target.npz"]
    with np.load(out / "target.npz") as archive:
        assert archive.files == ["depth"] and archive["depth"].dtype == np.float32
        assert archive["depth"].shape == (48, 64)
    before = load_depth(scene / "depth_initial" / "target.npz")
    after = load_depth(out / "target.npz")
    assert ((before > 0) == (after > 0)).all() and (before != after).any()
    page = (tmp_path / "page" / "index.html").read_text()
    for text in ("compared with the photos: ", "effects not needed: ", "balanced, pyramid.steps=3"):
        assert text in page
    assert (tmp_path / "page" / "target_change.png").is_file()


@pytest.mark.parametrize("more", [[], ["--fuse"]])
def test_refine_from_a_mesh_to_a_mesh(scene, tmp_path, more):
    pytest.importorskip("open3d")
    assert command_line.run(refine(scene, "--mesh", scene / "mesh_coarse.ply", "--output",
                                   tmp_path / "a" / "fine.ply", "--report", tmp_path / "page", *more)) == 0
    page = (tmp_path / "page" / "index.html").read_text()
    assert "<canvas" in page and "mesh_shaded_before.png" in page and "<dt>version</dt>" in page
    assert f"<code>pagas-cl refine {scene} " in page
    from pagas_cl.scene.meshes.files import read_mesh

    fine, coarse = read_mesh(tmp_path / "a" / "fine.ply"), read_mesh(scene / "mesh_coarse.ply")
    assert len(fine.faces) > 100
    assert (fine.normals is not None and fine.colors is not None) == bool(more)
    assert np.isfinite(fine.vertices).all()
    assert (np.abs(fine.vertices.mean(axis=0) - coarse.vertices.mean(axis=0)) < np.ptp(coarse.vertices, axis=0)).all()


def test_only_the_views_named_are_refined(scene, tmp_path):
    assert command_line.run(refine(scene, "--depth-dir", scene / "depth_initial", "--save-depth", tmp_path / "out",
                                   "--views", "target", "context_01.png")) == 0
    assert sorted(path.stem for path in (tmp_path / "out").glob("*.npz")) == ["context_01", "target"]


def test_two_runs_give_the_same_bytes(scene, tmp_path):
    for name in ("a", "b"):
        assert command_line.run(refine(scene, "--depth-dir", scene / "depth_initial", "--views", "target",
                                       "--save-depth", tmp_path / name)) == 0
    assert (tmp_path / "a" / "target.npz").read_bytes() == (tmp_path / "b" / "target.npz").read_bytes()


def test_depth_maps_of_another_size_and_missing_ones(scene, tmp_path, capsys, fails):
    depth = load_depth(scene / "depth_initial" / "target.npz")
    shutil.rmtree(scene / "depth_initial")
    save_depth(scene / "depth_initial" / "target.npz", depth[::2, ::2])
    assert command_line.run(refine(scene, "--depth-dir", scene / "depth_initial", "--save-depth",
                                   tmp_path / "out")) == 0
    assert load_depth(tmp_path / "out" / "target.npz").shape == (48, 64)
    assert [path.stem for path in (tmp_path / "out").glob("*.npz")] == ["target"]
    assert "2 views have no depth map in" in capsys.readouterr().err
    assert "no depth map of the view 'context_00.png', which is to be refined" in fails(
        2, *refine(scene, "--depth-dir", scene / "depth_initial", "--save-depth", tmp_path / "d", "--views",
                   "context_00"))


def test_an_interrupted_run_keeps_what_is_done(scene, tmp_path, monkeypatch, fails):
    import pagas_cl.method.view.one_view as refining

    whole, done = refining.fit_memory, []

    def once(*arguments, **keywords):
        if done:
            raise KeyboardInterrupt
        done.append(1)
        return whole(*arguments, **keywords)

    monkeypatch.setattr(refining, "fit_memory", once)
    out, page = tmp_path / "out", tmp_path / "page"
    assert "interrupted" in fails(130, *refine(scene, "--depth-dir", scene / "depth_initial", "--save-depth", out,
                                               "--report", page, "--effect", "agreement=off"))
    assert len(list(out.glob("*.npz"))) == 1 and (page / "index.html").is_file()


def test_devices(capsys):
    assert command_line.run(["devices"]) == 0
    printed = capsys.readouterr().out
    for word in ("driver", "memory", "lacks", "chosen: "):
        assert word in printed


def test_help_names_every_command(capsys):
    assert command_line.run([]) == 0
    printed = capsys.readouterr().out
    assert {"refine", "devices", "demo"} <= set(command_line.command_names())
    assert all(name in printed for name in command_line.command_names())


def test_every_command_has_help(capsys):
    for name in command_line.command_names():
        assert command_line.run([name, "--help"]) == 0
        assert "Usage: pagas-cl" in capsys.readouterr().out


def test_one_command_does_not_import_the_others():
    program = "import sys; from pagas_cl.__main__ import run; run(['devices', '--help']); " \
              "assert 'pagas_cl.app.commands.refine' not in sys.modules and 'pyopencl' not in sys.modules"
    assert subprocess.run([sys.executable, "-c", program], capture_output=True).returncode == 0


def test_a_present_folder_that_is_gone_is_named(tmp_path, monkeypatch, fails):
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    assert "the present folder cannot be written or read" in fails(1, "demo", "--width", "64")


def test_as_a_process():
    done = subprocess.run([sys.executable, "-m", "pagas_cl", "--version"], capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.startswith("pagas-cl ")
    done = subprocess.run([sys.executable, "-m", "pagas_cl", "refine"], capture_output=True, text=True)
    assert done.returncode == 2 and done.stdout == "" and len(done.stderr.splitlines()) == 1


# -- exit statuses -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("error, status, expected", [
    (InputError("bad photo"), 2, "bad photo"),
    (MissingExtraError("open3d", "mesh", "fusing"), 2, 'pip install "pagas-cl[mesh]"'),
    (NoDeviceError("no device"), 2, "no device"), (DeviceError("it is lost"), 1, "it is lost"),
    (ValueError("two\nlines"), 1, "ValueError: two lines (run again with --debug"),
    (MemoryError(), 1, "MemoryError"), (KeyboardInterrupt(), 130, "interrupted")])
def test_status_of(error, status, expected, monkeypatch, fails):
    import pagas_cl.runtime.listing as listing

    def raises(_):
        raise error

    monkeypatch.setattr(listing, "find_devices", raises)
    assert expected in fails(status, "devices")


def test_debug_shows_the_traceback(monkeypatch):
    import pagas_cl.runtime.listing as listing

    monkeypatch.setattr(listing, "find_devices", lambda _: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        command_line.run(["devices", "--debug"])


@pytest.mark.parametrize("arguments, expected", [
    (["refyne"], "Did you mean 'refine'"), (["refine"], "Missing argument 'SCENE'"),
    (["refine", "x", "--mash", "y"], "No such option"),
    (["devices", "--device", "no such"], "no OpenCL device matches")])
def test_bad_usage(arguments, expected, fails):
    assert expected in fails(2, *arguments)


# -- bad input ---------------------------------------------------------------------------------------------------


def test_requests_that_cannot_end_well(scene, tmp_path, fails, monkeypatch):
    """And leave nothing where they were made."""
    pytest.importorskip("open3d")
    depth = ["--depth-dir", scene / "depth_initial"]
    (tmp_path / "file").write_text("")
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    for more, expected in [
        ([], "either --mesh or --depth-dir"),
        ([*depth, "--mesh", "m.ply", "--save-depth", "d"], "got both"),
        (depth, "nothing to write"),
        ([*depth, "--output", "a.xyz"], "unknown kind '.xyz'"),
        ([*depth, "--save-depth", tmp_path / "file"], "is a file, expected a folder"),
        ([*depth, "--output", tmp_path / "file" / "new" / "a.ply"], "--output: cannot write in the folder"),
        ([*depth, "--report", tmp_path / "file" / "page"], "--report: cannot write in the folder"),
        ([*depth, "--output", "a.ply", "--memory", "-5"], "'--memory': -5, expected a number above 0"),
        (["--depth-dir", tmp_path / "none", "--save-depth", "d"], "is no folder"),
        (["--depth-dir", scene, "--save-depth", "d"], "holds no depth map of the scene's 3 views"),
        (["--depth-dir", scene, "--save-depth", "d"], "3 views, expected for instance target.npz (or .npy, .pfm, "),
        ([*depth, "--save-depth", "d", "--preset", "best"], "unknown preset 'best'"),
        ([*depth, "--save-depth", "d", "--set", "solver.rte=1"], "'solver.rate'"),
        ([*depth, "--save-depth", "d", "--set", "solver.rate=fast"], "expected a number"),
        ([*depth, "--save-depth", "d", "--set", "solver.rate"], "no '='"),
        ([*depth, "--save-depth", "d", "--context", "0"], "context.number is 0"),
        ([*depth, "--save-depth", "d", "--views", "targt"], "did you mean 'target'"),
        ([*depth, "--save-depth", "d", "--format", "no such"], "unknown format"),
        (["--mesh", tmp_path / "none.ply", "--save-depth", "d"], "does not exist"),
    ]:
        assert expected in fails(2, *refine(scene, *more)), expected
    assert "does not exist" in fails(2, *refine(tmp_path / "none", *depth, "--save-depth", "d"))
    assert not list((tmp_path / "here").iterdir())


def test_every_command_says_before_the_work_that_it_cannot_write(scene, tmp_path, fails):
    place = tmp_path / "file"
    place.write_text("")
    start = [scene, "--depth-dir", scene / "depth_initial"]
    for arguments in (["demo", "--output", place], ["analyze", *start, "--json", place / "a.json"],
                      ["tradeoff", *start, "--report", place],
                      ["evaluate", scene / "depth_initial", "--json", place / "a.json"]):
        assert f"'{place}' is a file" in fails(2, *arguments), arguments
    assert [path.name for path in tmp_path.iterdir() if path != scene] == ["file"]


@pytest.mark.slow
def test_a_budget_too_small_for_any_setting(scene, fails):
    assert "--budget 1e-06 minutes are too few" in fails(2, "tradeoff", scene, "--depth-dir", scene / "depth_initial",
                                                         "--views", "target", "--budget", "1e-6")


def spoil(scene, how):
    image = scene / "images" / "context_00.png"
    depth = scene / "depth_initial"
    if how == "missing":
        image.unlink()
    elif how == "cut off":
        image.write_bytes(image.read_bytes()[:2000])
    elif how == "unreadable":
        image.write_bytes(b"no picture")
    elif how == "size":
        Image.new("RGB", (10, 10)).save(image)
    elif how == "mask size":
        (scene / "masks").mkdir()
        Image.new("L", (10, 10), 255).save(scene / "masks" / "target.png")
    elif how == "all-zero depth":
        for file in depth.iterdir():
            save_depth(file, np.zeros((48, 64)))
    elif how == "broken depth":
        (depth / "target.npz").write_bytes(b"no archive")


@pytest.mark.parametrize("how, expected", [
    ("missing", "view 1: image: there is no file"), ("unreadable", "context_00"), ("size", "its camera says 64 x 48"),
    ("mask size", "mask"), ("all-zero depth", "valid pixel"),
    ("broken depth", "target.npz' cannot be read: it is no .npz archive")])
def test_bad_files(scene, tmp_path, fails, how, expected):
    spoil(scene, how)
    sentence = fails(2, *refine(scene, "--depth-dir", scene / "depth_initial", "--save-depth", tmp_path / "d"))
    assert expected in sentence
    assert not (tmp_path / "d").exists()


def test_a_photo_cut_off_is_read_once(scene, tmp_path, fails, caplog):
    spoil(scene, "cut off")
    sentence = fails(2, *refine(scene, "--depth-dir", scene / "depth_initial", "--save-depth", tmp_path / "d",
                                "--views",
                                "context_00"))
    assert "context_00.png' cannot be decoded" in sentence and "tried again" not in caplog.text


def test_no_opencl_platform(scene, tmp_path):
    """In a process of its own, since the loader looks for drivers once."""
    done = subprocess.run(
        [sys.executable, "-m", "pagas_cl",
         *refine(scene, "--depth-dir", scene / "depth_initial", "--save-depth", tmp_path)],
        env={"OCL_ICD_VENDORS": "/nonexistent", "PATH": "/usr/bin:/bin", "HOME": str(tmp_path)}, capture_output=True,
        text=True)
    assert done.returncode == 2
    assert "no OpenCL platform found" in done.stderr and 'pip install "pagas-cl[cpu]"' in done.stderr


# -- the parts ---------------------------------------------------------------------------------------------------


def test_a_command_line_is_that_of_the_systems_shell(monkeypatch):
    words = ["pagas-cl", "check", "C:\\my scene"]
    assert typed(words) == "pagas-cl check 'C:\\my scene'"
    monkeypatch.setattr(sys, "platform", "win32")
    assert typed(words) == 'pagas-cl check "C:\\my scene"'      # single quotes are nothing special there


def test_options_that_take_several_values():
    expanded = command_line.expand_lists(["refine", "s", "--views", "a", "b", "--set", "x=1", "--mesh", "m", "--quiet"],
                                 ("--views", "--set"))
    assert expanded == ["refine", "s", "--views", "a", "--views", "b", "--set", "x=1", "--mesh", "m", "--quiet"]
    for words in (["--views"], ["--set", "x=1", "--views", "--quiet"], ["--views", "--views", "a"]):
        with pytest.raises(InputError, match="--views has no value"):
            command_line.expand_lists(words, ("--views", "--set"))


def test_settings_take_the_type_of_their_field():
    config = build_config("paper", ["splatting.radius=2", "loss.grey=yes", "pyramid.scales=0.25,1", "pyramid.steps=5,6",
                                    "splatting.blend=order_free", "context.number=3"])
    assert config.splatting.radius == 2 and config.loss.grey is True and config.context.number == 3
    assert config.pyramid.scales == (0.25, 1.0) and config.pyramid.steps == (5, 6)
    assert config.splatting.blend == "order_free"
    with pytest.raises(InputError, match="expected true or false"):
        build_config("paper", ["loss.grey=perhaps"])
