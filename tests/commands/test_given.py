"""What refine and check find out by themselves about what they were given, in examples of every format."""

import json

import numpy as np
import pytest
from PIL import Image
from support.example_scenes import frames_of, write_example
from support.exports_depth import EXPORTS
from support.scenes import relief_scene

from pagas_cl.__main__ import run
from pagas_cl.app.commands._given import look, together
from pagas_cl.errors import InputError
from pagas_cl.progress import NONE
from pagas_cl.scene.depthmap import load_depth
from pagas_cl.scene.mesh import Surface
from pagas_cl.scene.meshes.files import write_mesh

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def made():
    return relief_scene(168, 126, 2, held_out=0)


@pytest.mark.parametrize("format", EXPORTS)
def test_every_example_is_understood(format, made, tmp_path):
    folder = write_example(tmp_path / "scene", format, made)
    options = {"photos": folder / "photos"} if format == "mapanything-colmap" else \
        {"format": "meshlab"} if format == "meshlab" else {}
    given = look(folder, **options)
    photos, cameras, depth = given.lines()
    assert photos.startswith("photos: 3 of 168 x 126, from ") and cameras.startswith("cameras: 3, focal length 31")
    assert depth.startswith("depth: maps of every view, from ") and "; unit: " in depth
    assert all(np.median(d.load()) == pytest.approx(3.25, rel=0.3) for d in given.depths)


def test_png_without_a_unit(made, tmp_path):
    folder = write_example(tmp_path / "scene", "cameras", made)
    for path in sorted((folder / "depth").glob("*.npz")):
        Image.fromarray(np.rint(1000 * load_depth(path)).astype(np.uint16)).save(path.with_suffix(".png"))
        path.unlink()
    given = look(folder)
    assert np.median(together(given, True)[0].load()) == pytest.approx(3.25, rel=0.1)
    assert "1000 for one scene unit, as you say" in look(folder, depth_scale=1000).lines()[2]
    for path in (folder / "images").iterdir():      # photos that say nothing
        Image.fromarray(np.full((126, 168, 3), 90, np.uint8)).save(path)
    with pytest.raises(InputError, match="do not say their unit, and photos do not show it"):
        together(look(folder), True)


def test_a_mesh_in_the_folder_and_what_is_refused(made, tmp_path, capsys):
    import shutil

    folder = write_example(tmp_path / "scene", "cameras", made)
    shutil.rmtree(folder / "depth")
    assert look(folder).lines()[2] == "no depth and no mesh"
    vertices = "ply\nformat ascii 1.0\nelement vertex 1\nproperty int x\nproperty int y\nproperty int z\n"
    faces = "element face 1\nproperty list uchar int vertex_indices\n"
    (folder / "a.ply").write_text(f"{vertices}{faces}end_header\n0 0 0\n3 0 0 0\n")
    (folder / "cloud.ply").write_text(f"{vertices}end_header\n0 0 0\n")
    (folder / "._a.ply").write_bytes(b"\0\5\x16\7")      # as macOS leaves it on disks that are not its own
    assert look(folder).mesh == folder / "a.ply"
    (folder / "b.obj").write_text("")
    with pytest.raises(InputError, match="several meshes .*a.ply, b.obj.*--mesh"):
        look(folder)
    with pytest.raises(InputError, match="--photos does not go with the format"):
        look(folder, photos=folder)
    assert run(["check", str(folder), "--depth-scale", "-1"]) == 2
    assert "-1, expected a number above 0" in capsys.readouterr().err


def test_what_earlier_runs_have_written_is_no_start_where_there_is_another(made, tmp_path):
    """The same command took its own results for its start, or could not go on from them."""
    folder = write_example(tmp_path / "scene", "cameras", made)
    (folder / "depth" / ".pagas_cl").mkdir()
    assert look(folder).where == str(folder / "depth")
    write_mesh(folder / "fine.ply", Surface(*made.initial_mesh(8.0)))
    assert look(folder).mesh == folder / "fine.ply"
    coarse = (folder / "fine.ply").read_bytes().replace(b"comment written by pagas_cl\n", b"")
    (folder / "coarse.ply").write_bytes(coarse)
    assert look(folder).mesh == folder / "coarse.ply"
    (folder / "depth").rename(folder / "depth_maps")
    assert look(folder).mesh == folder / "coarse.ply"
    (folder / "depth_maps" / ".pagas_cl").rmdir()
    assert look(folder).where == str(folder / "depth_maps")


def test_check_answers_for_depth(made, tmp_path, capsys):
    assert run(["check", str(write_example(tmp_path / "scene", "vggt", made))]) == 0
    said = capsys.readouterr()
    assert "the cameras are right as they are" in said.out and "depth maps disagreed by" in said.err
    assert "3 of 3 cameras see the surface of the depth maps, and" in said.out and "mesh" not in said.out


def test_check_finds_inverted_poses_by_depth_maps_which_move_with_them(made, tmp_path, capsys):
    folder = tmp_path / "scene"
    EXPORTS["vggt"](folder, frames_of(made))
    arrays = dict(np.load(folder / "predictions.npz"))
    whole = np.concatenate([arrays["extrinsic"], np.tile(np.eye(4, dtype=np.float32)[3:], (3, 1, 1))], axis=1)
    np.savez(folder / "predictions.npz", **{**arrays, "extrinsic": np.linalg.inv(whole)[:, :3]})
    for more in ((), ("--json",)):
        assert run(["check", str(folder), *more]) == 2
        said = capsys.readouterr()
        assert "with the inverse matrices of the cameras the photos agree" in said.err
    assert not json.loads(said.out)["ok"]


def test_a_mesh_is_drawn_on_the_device_that_is_named(made, tmp_path, monkeypatch):
    folder, drawn_on = write_example(tmp_path / "scene", "cameras", made), []
    write_mesh(tmp_path / "mesh.ply", Surface(*made.initial_mesh(4.0)))
    monkeypatch.setattr("pagas_cl.refine.each_depth",
                        lambda surface, cameras, device: drawn_on.append(device) or [None] * len(cameras))
    for name, instead in (("comparison_device", lambda device: device), ("check_seen", lambda *_: None)):
        monkeypatch.setattr(f"pagas_cl.refine.{name}", instead)
    look(folder, mesh=tmp_path / "mesh.ply").initial_depths(NONE, "the one that is named")
    assert drawn_on == ["the one that is named"]


@pytest.mark.parametrize("command, works", [("check SCENE --mesh m.ply", "check.check_views"),
                                            ("refine SCENE --mesh m.ply --output o.ply", "refine._refine")])
def test_a_photo_that_is_cut_off_is_refused_before_the_work(made, tmp_path, capsys, monkeypatch, command, works):
    monkeypatch.chdir(tmp_path)
    folder, worked = write_example(tmp_path / "SCENE", "cameras", made), []
    write_mesh(tmp_path / "m.ply", Surface(*made.initial_mesh(4.0)))
    path = sorted((folder / "images").iterdir())[1]
    path.write_bytes(path.read_bytes()[:-300])
    monkeypatch.setattr(f"pagas_cl.app.commands.{works}", lambda *args: worked.append(args))
    assert run(command.split()) == 2 and not worked
    assert f"{path.name}' cannot be decoded" in capsys.readouterr().err
