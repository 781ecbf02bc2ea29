"""The demo's flow with a refinement that is faked, and the scene folder that it writes; then the real one."""

import re
import sys

import numpy as np
import pytest
from support.scenes import tiny
from support.synthetic.scene import write_scene

from pagas_cl.__main__ import run
from pagas_cl.app.demo_scene import CLUSTERED, FAR, make_scene
from pagas_cl.app.evaluate.depth import compare_depth
from pagas_cl.config.presets import BALANCED
from pagas_cl.errors import InputError
from pagas_cl.method.view.prediction import compare_predictions
from pagas_cl.refine import refine_views
from pagas_cl.result import DepthResult
from pagas_cl.scene.depthmap import load_depth
from pagas_cl.scene.readers import read_scene

pytestmark = pytest.mark.slow


@pytest.fixture
def folder(tmp_path):
    return write_scene(tiny(foreground=True), tmp_path / "scene")


def test_scene_folder_reads_back(folder):
    made = tiny(foreground=True)
    scene = read_scene(folder)
    assert [view.name for view in scene.views] == [f"{view.name}.png" for view in made.all_views]
    for read, view in zip(scene.views, made.all_views):
        assert np.array_equal(read.load_image(), view.load_image())
        assert np.array_equal(read.load_mask(), view.load_mask())
        assert np.allclose(read.camera.world_to_camera, view.camera.world_to_camera, atol=0)
    depth = load_depth(folder / "depth_true" / "target.npz")
    assert np.array_equal(depth, made.true_depth(made.cameras[0]))


def test_coarse_mesh_file_reads_back(folder):
    o3d = pytest.importorskip("open3d", reason="Open3D is not installed", exc_type=ImportError)
    vertices, faces = tiny(foreground=True).initial_mesh()
    mesh = o3d.io.read_triangle_mesh(str(folder / "mesh_coarse.ply"))
    assert np.array_equal(np.asarray(mesh.vertices), vertices)
    assert np.array_equal(np.asarray(mesh.triangles), faces)


def test_evaluate_command_on_the_folder(folder, capsys):
    status = run(["evaluate", str(folder / "depth_initial"), str(folder / "depth_true"), "--scene", str(folder),
                  "--held-out", "held_out_0.png", "--before", str(folder / "depth_true")])
    said = capsys.readouterr()
    assert status == 0, said.err
    assert "target.png: depth error" in said.out and "target.png from held_out_0.png" in said.out
    assert run(["evaluate", str(folder / "depth_initial"), "--scene", str(folder)]) == 2


def test_demo_with_a_faked_refinement(device, tmp_path, capsys, monkeypatch):
    truth = {}

    def refine_depth(target, contexts, depth, **_):
        assert all(context is not target for context in contexts)
        half = 0.5 * (depth + truth[target.name])
        return DepthResult(target.camera, half, (half > 0).astype(np.uint8), half, half)

    monkeypatch.setattr("pagas_cl.app.commands.demo.refine_depth", refine_depth)
    monkeypatch.setitem(sys.modules, "open3d", None)
    made = make_scene(96, 72, 2, device)
    truth.update({view.name: true for view, true in zip(made.views, made.true, strict=True)})
    status = run(["demo", "--output", str(tmp_path), "--width", "96", "--context", "2", "--quiet"])
    said = capsys.readouterr()
    assert status == 0, said.err
    assert "target" in said.out and "correlation with the held-out photo" in said.out
    assert (tmp_path / "report" / "index.html").is_file()
    assert run(["demo", "--output", str(tmp_path), "--width", "96", "--context", "2", "--quiet"]) == 0    # its own
    old, new = map(float, re.search(r"target\s+([\d.]+) -> ([\d.]+)", said.out).groups())
    assert new == pytest.approx(0.5 * old, rel=0.05)


def test_demo_replaces_nothing_of_others(tmp_path, capsys):
    for name in ("scene", "report", "mesh_refined.ply"):
        (tmp_path / name).write_text("theirs")
        assert run(["demo", "--output", str(tmp_path)]) == 2
        assert f"{name}' was not written by pagas_cl: choose another folder" in capsys.readouterr().err
        assert [path.read_text() for path in tmp_path.iterdir()] == ["theirs"]
        (tmp_path / name).unlink()


def test_photos_of_the_demo_agree_through_its_true_depth(device):
    made = make_scene(160, 120, 2, device)
    true, initial = compare_predictions(made.views[0], [made.true[0], made.initial[0]], made.views[-1])
    assert true.median > 0.98 and true.median > initial.median + 0.005
    off = compare_depth(made.initial[0], made.true[0], made.views[0].camera, parallax=made.parallax)
    assert 0.2 < off.smooth.mean_parallax < 0.35 and all((depth > 0).all() for depth in made.true)
    again = make_scene(160, 120, 2, device)
    assert all((a.image == b.image).all() for a, b in zip(made.views, again.views, strict=True))


@pytest.mark.parametrize("given, said", [((4, 72, 2), "photos of 4 x 72"), ((96, 72, 17), "17 context views")])
def test_a_demo_scene_that_cannot_be(given, said):
    with pytest.raises(InputError, match=said):
        make_scene(*given, None)


def test_demo_on_a_device(tmp_path):
    from pagas_cl.app.commands.demo import run_demo

    result = run_demo(tmp_path, width=140, contexts=4)
    old, new = result.before["target"].smooth, result.after["target"].smooth
    assert new.mean < 0.6 * old.mean and new.normal_mean < old.normal_mean
    assert result.prediction[1] > result.prediction[0]


@pytest.mark.parametrize("clustered", [CLUSTERED, 1.5 * CLUSTERED])
def test_a_start_that_is_far_off(device, clustered):
    """The scene of `demo --hard`, as large as issue 38 says: 0.25 and 0.037 units, of which 1.2 are a pixel of
    parallax."""
    pytest.importorskip("open3d", reason="Open3D is not installed", exc_type=ImportError)
    made = make_scene(388, 290, 5, device, FAR, clustered)
    views, depths, true = made.views[:-1], made.initial[:-1], made.true[:-1]
    names = [view.name for view in views[:3]]       # half of them: the others are seen by these
    after = errors([result.depth for result in refine_views(views, depths, names=names, device=device)], true[:3],
                   made.parallax)
    assert 1.2 * errors(depths, true, made.parallax).mean() > 0.7
    assert 1.2 * after.mean() < 0.25 and 1.2 * np.median(after) < 0.037


def test_hypotheses_at_a_start_that_is_far_off(device):
    """They take the mean error down, and leave what was near where it was."""
    pytest.importorskip("open3d", reason="Open3D is not installed", exc_type=ImportError)
    made = make_scene(144, 108, 4, device, FAR, CLUSTERED)
    views, depths, true = made.views[:-1], made.initial[:-1], made.true[:-1]
    before = errors(depths, true, made.parallax)
    after = {choice: errors([result.depth for result in refine_views(
        views, depths, config=BALANCED.with_settings(effects__hypotheses=choice), device=device)], true,
        made.parallax) for choice in ("off", "auto")}
    assert after["auto"].mean() < 0.92 * after["off"].mean() < 0.92 * before.mean()
    assert np.median(after["auto"]) < 1.02 * np.median(after["off"])
    near = before < 0.25
    assert after["auto"][near].mean() < 1.2 * after["off"][near].mean()


def errors(depths, true, parallax):
    """Of all pixels, in pixels of parallax."""
    return np.concatenate([np.abs(depth - right).ravel() / parallax for depth, right in zip(depths, true)])
