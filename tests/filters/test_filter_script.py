"""Filter scripts that mix MeshLab's filters and our step: checked whole, run, saved, run again."""

from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

pymeshlab = pytest.importorskip("pymeshlab")

from support.scenes import relief_scene  # noqa: E402

from pagas_cl.errors import InputError  # noqa: E402
from pagas_cl.filters import filter_script, native, parameters  # noqa: E402
from pagas_cl.filters.filter_script import check_script, run_script  # noqa: E402
from pagas_cl.runtime.device import open_device  # noqa: E402
from pagas_cl.scene.readers.meshlab import MeshLayer, write_project  # noqa: E402
from pagas_cl.scene.view import View  # noqa: E402

pytestmark = pytest.mark.slow

PAGAS_STEP = ('<filter name="PAGaS Depth Refinement"><Param type="RichString" name="settings" value="pyramid.steps=8"/>'
        '<Param type="RichFloat" name="voxel" value="2"/></filter>')
SMOOTH = ('<filter name="Laplacian Smooth"><Param type="RichInt" name="stepSmoothNum" value="1"/>'
          '<Param type="RichBool" name="Boundary" value="true"/></filter>')
FIVE = ('<filter name="Remove Duplicate Vertices"/>' + SMOOTH + PAGAS_STEP + '<!-- a comment -->'
        '<filter name="Remove Unreferenced Vertices"/><filter name="Re-Compute Vertex Normals"/>')


def script(folder, body, name="s.mlx") -> Path:
    path = folder / name
    path.write_text(f"<!DOCTYPE FilterScript>\n<FilterScript>\n{body}\n</FilterScript>\n")
    return path


@pytest.fixture(scope="module")
def made():
    return relief_scene(64, 48, contexts=2, held_out=0, steps=0)


def meshes_of(made):
    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(*made.initial_mesh(3.0)), "coarse")
    return meshes


@pytest.mark.parametrize("body, sentence", [
    (SMOOTH + '<filter name="PAGaS Deph Refinement"/>', "step 2 'PAGaS Deph Refinement' is neither a step of "
     "pagas_cl nor a filter of pymeshlab; did you mean 'PAGaS Depth Refinement'. nothing was run"),
    ('<filter name="Laplacain Smooth"/>', "did you mean 'Laplacian Smooth'. nothing was run"),
    ('<filter name="laplacian smooth"/>', "did you mean 'Laplacian Smooth'"),
    ('<filter name="apply_coord_laplacian_smoothing"/>', "did you mean 'Laplacian Smooth'|neither a step"),
    (SMOOTH.replace("stepSmoothNum", "stepSmothNum"), "unknown parameter 'stepSmothNum'; .* 'stepSmoothNum'"),
    (SMOOTH.replace("RichInt", "RichFloat"), "has type 'RichFloat', expected 'RichInt'"),
    (SMOOTH.replace('value="1"', 'value="1.5"'), "whole number"),
    (SMOOTH.replace('value="1"', 'value="many"'), "expected a number"),
    (SMOOTH.replace('value="true"', 'value="yes"'), "expected 'true' or 'false'"),
    ('<filter name="Re-Compute Vertex Normals"><Param type="RichEnum" name="weightMode" value="4"/></filter>',
     "whole number from 0 to 3"),
    (PAGAS_STEP.replace('"voxel"', '"voxels"'), "unknown parameter 'voxels'; the nearest one is 'voxel'"),
    (PAGAS_STEP.replace("RichFloat", "RichInt"), "has type 'RichInt', expected 'RichFloat'"),
    (PAGAS_STEP.replace('value="2"', 'value="nan"'), "expected a number"),
    (PAGAS_STEP.replace('value="2"', 'value="-1"'), "fusion.voxel is -1"),
    (PAGAS_STEP.replace("pyramid.steps=8", "pyramid.stepz=8"), "unknown setting"),
    (PAGAS_STEP.replace("pyramid.steps=8", "__class__.x=8"), "unknown setting"),
    ('<xmlfilter name="Perlin color"/>', "xmlfilter"),
    ('<other/>', "expected <filter"),
    ("", "no steps"),
    ('<filter name="Project active rasters color to current mesh"/>', "ends the whole Python process here"),
    ('<filter name="Export active rasters cameras to file"/>', "reads or writes files of its own"),
    (SMOOTH.replace("</filter>", "<x/></filter>"), "not <Param>"),
])
def test_the_whole_script_is_checked_before_anything_runs(tmp_path, made, body, sentence):
    meshes = meshes_of(made)
    before = meshes.current_mesh().vertex_matrix()
    with pytest.raises(InputError, match=sentence):
        run_script(meshes, script(tmp_path, body), made.views)
    assert np.array_equal(meshes.current_mesh().vertex_matrix(), before) and meshes.mesh_number() == 1


@pytest.mark.parametrize("text", ["", "no xml", "<a/>", "<FilterScript>", "\0\1\2",
                                  '<!DOCTYPE F [<!ENTITY a "b">]><FilterScript><filter name="&a;"/></FilterScript>'])
def test_what_is_no_script_is_refused(tmp_path, text):
    (tmp_path / "s.mlx").write_text(text)
    with pytest.raises(InputError):
        check_script(tmp_path / "s.mlx")
    with pytest.raises(InputError, match="cannot be read"):
        check_script(tmp_path / "none.mlx")


@pytest.mark.parametrize("change, sentence", [
    ({"meshes": None}, "meshes is None, expected a pymeshlab.MeshSet"),
    ({"path": None}, "path is None, expected a path"),
    ({"names": "scalar_Height"}, "names is a str, expected a list of names"),
])
def test_arguments_of_a_wrong_kind_are_named(tmp_path, made, change, sentence):
    given = {"meshes": meshes_of(made), "path": script(tmp_path, PAGAS_STEP), "scene": made.views}
    with pytest.raises(InputError, match=sentence):
        run_script(**{**given, **change})


def test_the_shipped_script_is_right():
    from importlib.resources import files

    (step,) = check_script(files("pagas_cl.filters") / "refine.mlx")
    assert step.request.making.output == "mesh" and step.request.config.context.number == 10


def test_mixed_script_runs_and_is_saved_and_runs_again(tmp_path, made):
    """Five steps, the PAGaS step in the middle; pymeshlab saves it with that step, and the saved script gives
    the same mesh."""
    meshes = meshes_of(made)
    path = script(tmp_path, FIVE)
    steps = run_script(meshes, path, made.views)
    assert [step.request is not None for step in steps] == [False, False, True, False, False]
    assert meshes.mesh_number() == 2 and meshes.current_mesh().label() == "coarse refined"
    result = meshes.current_mesh()
    assert result.face_number() > 100 and result.has_vertex_color()
    quality = result.vertex_scalar_array()
    assert 0 <= quality.min() and quality.max() <= 1 and quality.mean() > 0.05
    assert np.allclose(np.linalg.norm(result.vertex_normal_matrix(), axis=1), 1)
    saved = tmp_path / "saved.mlx"
    meshes.save_filter_script(str(saved))
    again = check_script(saved)
    assert [step.name for step in again] == [step.name for step in steps]
    assert asdict(again[2].request) == asdict(steps[2].request)
    second = meshes_of(made)
    run_script(second, saved, made.views)
    assert np.array_equal(second.current_mesh().vertex_matrix(), result.vertex_matrix())
    assert np.array_equal(second.current_mesh().face_matrix(), result.face_matrix())


def test_history_before_and_failure_inside_are_kept(tmp_path, made):
    meshes = meshes_of(made)
    meshes.apply_filter("meshing_remove_duplicate_faces")
    path = script(tmp_path, SMOOTH + PAGAS_STEP + '<filter name="Fit a plane to selection"/>')  # there is no selection
    with pytest.raises(InputError, match="pymeshlab stopped in step 3 'Fit a plane to selection'.*[Ss]election"):
        run_script(meshes, path, made.views)
    history = [element.get("name") for element in filter_script.saved_history(meshes)]
    assert history == ["Remove Duplicate Faces", "Laplacian Smooth", "PAGaS Depth Refinement"]


def test_script_without_our_step_needs_no_scene(tmp_path, made):
    meshes = meshes_of(made)
    run_script(meshes, script(tmp_path, SMOOTH))
    with pytest.raises(InputError, match="needs a scene"):
        run_script(meshes, script(tmp_path, PAGAS_STEP))
    with pytest.raises(InputError, match="no mesh to start from"):
        run_script(pymeshlab.MeshSet(), script(tmp_path, SMOOTH))


def test_lengths_are_relative():
    """No parameter of the step is a length in scene units."""
    assert {p.rich for p in parameters.PARAMETERS} == {"RichString", "RichFloat", "RichInt"}
    for p in parameters.PARAMETERS:
        assert p.rich == "RichString" or any(w in p.description.lower() for w in ("pixel", "views", "weight"))


def test_pymeshlab_is_probed_again_after_a_crash():
    """A name that aborts the child does not keep the others from being answered."""
    found = native.look_up(["Project active rasters color to current mesh", "Sphere", "No such filter"])
    assert [f.exists for f in found.values()] == [True, True, False]
    assert found["Project active rasters color to current mesh"].crash.startswith("crashed (SIGABRT")
    assert found["Sphere"].types == {"radius": "RichFloat", "subdiv": "RichInt"}


# -- the command ----------------------------------------------------------------------------------------------------


def test_command_with_mesh_and_scene(tmp_path, made):
    from support.synthetic.scene import write_scene

    from pagas_cl.__main__ import run

    write_scene(made, tmp_path / "SCENE")
    mesh = tmp_path / "SCENE" / "mesh_coarse.ply"
    arguments = ["script", str(script(tmp_path, FIVE)), str(tmp_path / "SCENE"), "--mesh", str(mesh), "--quiet"]
    assert run([*arguments, "--output", str(tmp_path / "fine.ply"), "--save-script", str(tmp_path / "h.mlx")]) == 0
    assert (tmp_path / "fine.ply").stat().st_size > 1000
    assert len(check_script(tmp_path / "h.mlx")) == 5
    assert run([*arguments[:3], "--mesh", "none.ply", "--output", str(tmp_path / "x.ply")]) == 2
    assert run([*arguments[:3], "--output", str(tmp_path / "x.ply")]) == 2
    assert run([*arguments, "--output", str(tmp_path / "x.unknown")]) == 2
    assert not (tmp_path / "x.unknown").exists()


@pytest.fixture
def project(tmp_path, made):
    """The synthetic scene as a MeshLab project whose layer lies turned and scaled, and is put right by its matrix."""
    views = []
    for view in made.views:
        path = tmp_path / f"{view.camera.name}.png"
        Image.fromarray(view.image).save(path)
        views.append(View(view.camera, path, None, path.name))
    matrix = np.array([[0, -0.5, 0, 7.0], [0.5, 0, 0, -3], [0, 0, 0.5, 1], [0, 0, 0, 1]])
    vertices, faces = made.initial_mesh(3.0)
    local = np.linalg.solve(matrix[:3, :3], (vertices - matrix[:3, 3]).T).T
    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(local, faces))
    meshes.save_current_mesh(str(tmp_path / "coarse.ply"))
    return write_project(tmp_path / "p.mlp", views, [MeshLayer("coarse", tmp_path / "coarse.ply", matrix)])


@pytest.mark.parametrize("output", ["mesh", "tsdf", "displace"])
def test_command_with_project(project, output, made):
    """The result lies where the truth is once its layer's matrix is applied."""
    from pagas_cl.__main__ import run
    from pagas_cl.scene.readers.meshlab import read_project

    folder = project.parent
    body = FIVE.replace("</filter><!--", f'<Param type="RichString" name="output" value="{output}"/></filter><!--')
    assert run(["script", str(script(folder, body)), "--project", str(project), "--output", str(folder / "out.mlp"),
                "--quiet"]) == 0
    layers = read_project(folder / "out.mlp").meshes
    assert [layer.label for layer in layers] == (["coarse"] if output == "displace" else ["coarse", "coarse refined"])
    assert np.array_equal(layers[-1].matrix, layers[0].matrix)
    meshes = pymeshlab.MeshSet()
    meshes.load_project(str(folder / "out.mlp"))
    meshes.set_current_mesh(len(layers) - 1)
    world = meshes.current_mesh().transformed_vertex_matrix()
    inner = world[(np.abs(world[:, 0]) < 90) & (np.abs(world[:, 1]) < 60)]
    height = made.true_solid.height(inner[:, 0], inner[:, 1])[0]
    assert len(inner) > 50 and abs(np.corrcoef(inner[:, 2], height)[0, 1]) > 0.8  # smoothed; 5 units a pixel
    assert abs((inner[:, 2] - height).mean()) < 4


def test_the_device_that_is_named_moves_a_layer_too(made, tmp_path, monkeypatch):
    """In place of the one that the script names."""
    from pagas_cl.filters import pymeshlab_step

    named, whole = [], pymeshlab_step.solve_device
    monkeypatch.setattr(pymeshlab_step, "solve_device", lambda device: named.append(device) or whole(device))
    step = PAGAS_STEP.replace("</filter>", '<Param type="RichString" name="output" value="displace"/>'
                              '<Param type="RichString" name="device" value="no such device"/></filter>')
    name = open_device(None).info.name
    run_script(meshes_of(made), script(tmp_path, step), made.views, device=name)
    assert named == [name]
