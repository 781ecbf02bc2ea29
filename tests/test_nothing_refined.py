"""Refined means that evidence moved it; a run that refines nothing says so, and why, wherever it was started."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from support.scenes import relief_scene
from support.synthetic.scene import write_scene

import pagas_cl.__main__ as command_line
from pagas_cl.errors import InputError, NothingRefinedWarning
from pagas_cl.method.view.one_view import refine_depth
from pagas_cl.refine import initial_depths, refine_mesh, refine_views
from pagas_cl.result import KEPT, REFINED, DepthResult
from pagas_cl.scene.camera import inverse_pose
from pagas_cl.scene.check.reasons import likely_reasons, warn_of_nothing
from pagas_cl.scene.mesh import Surface

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def made():
    return relief_scene(96, 72, 3, held_out=0)


@pytest.fixture
def given(made):
    return list(made.views), [made.initial_depth(camera) for camera in made.cameras]


def painted(views, grey):
    return [replace(view, image=np.full_like(view.load_image(), grey)) for view in views]


def masked(views, depths, keep):
    return [replace(view, mask=(depth > 0) == keep) for view, depth in zip(views, depths)]


# what is done to views and depths, and reason of the reason that is named
MISTAKES = {
    "black photos": (lambda views, depths: (painted(views, 0), depths), "of one colour"),
    "white photos": (lambda views, depths: (painted(views, 255), depths), "of one colour"),
    "inverted masks": (lambda views, depths: (masked(views, depths, False), depths), "masks leave 0.0%"),
    "millimetres": (lambda views, depths: (views, [depth * 1000 for depth in depths]), "depths times 0.001"),
    "metres": (lambda views, depths: (views, [depth / 1000 for depth in depths]), "depths times 1000"),
    "inches": (lambda views, depths: (views, [depth / 0.0254 for depth in depths]), "depths times 0.0254"),
    "a renderer's background": (lambda views, depths: (views, [np.where(np.arange(96) < 30, depth, 1e10)
                                                               for depth in depths]), "69% of the depths are 1e+10"),
    "inverted poses": (lambda views, depths: ([replace(v, camera=replace(
        v.camera, world_to_camera=inverse_pose(v.camera.world_to_camera))) for v in views], depths), "inverse matr"),
    "photos of their neighbours": (lambda views, depths: (
        [replace(view, image=other.image) for view, other in zip(views, views[1:] + views[:1])], depths),
        "paired rightly"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_the_likeliest_reason_is_named(given, mistake):
    spoil, reason = MISTAKES[mistake]
    assert reason in likely_reasons(*spoil(*given))[0]


def test_reasons_that_differ_in_their_figures_are_counted_as_one(made):
    """Each view has its own: it was "1 of 4 views"."""
    results = [DepthResult.unrefined(camera, np.ones((72, 96)), f"off by {k}.5 pixels (00{k}.png)")
               for k, camera in enumerate(made.cameras)]
    with pytest.warns(NothingRefinedWarning,
                      match=r"likeliest: 4 of 4 views: for instance, off by 0.5 pixels \(000.png\)"):
        warn_of_nothing(made.views, [None] * 4, results)


def test_a_mesh_in_another_unit_is_named(made):
    """It is scaled about the world's origin: here 60 units beside the first camera, so that all still see it."""
    shift = np.array([60.0, 0.0, 0.0]) - made.cameras[0].center
    views = [replace(view, camera=replace(view.camera, world_to_camera=moved(view.camera.world_to_camera, shift)))
             for view in made.views]
    vertices, faces = made.initial_mesh()
    right, large = (Surface(unit * (vertices + shift), faces) for unit in (1, 10))
    assert likely_reasons(views, initial_depths(right, views)) == []
    assert "scaled by 0.1 about the origin" in likely_reasons(views, initial_depths(large, views))[0]


def test_inverted_poses_are_named_where_a_mesh_is_given(made):
    """In the world of the first camera, where inverted cameras see the mesh as well."""
    first = made.cameras[0].world_to_camera
    poses = [view.camera.world_to_camera @ inverse_pose(first) for view in made.views]
    views = [replace(view, camera=replace(view.camera, world_to_camera=inverse_pose(pose)))
             for view, pose in zip(made.views, poses)]
    vertices, faces = made.initial_mesh()
    depths = initial_depths(Surface(vertices @ first[:3, :3].T + first[:3, 3], faces), views)
    assert "with the inverse matrices of the cameras the photos agree" in likely_reasons(views, depths)[0]


@pytest.mark.parametrize("quarters", [1, -1])
def test_a_mesh_that_another_program_has_turned_is_named(made, quarters):
    """y up in place of z; edge on, and scaled to a dot about a point of the surface, it fits any photo a little."""
    vertices, faces = made.initial_mesh()
    x, y, z = vertices.T
    depths = initial_depths(Surface(np.column_stack([x, -quarters * z, quarters * y]), faces), made.views)
    assert f"mesh turned by {-90 * quarters} degrees about x the photos agree" in likely_reasons(made.views, depths)[0]


def test_a_surface_that_the_origin_lies_on_is_not_blamed_on_its_unit():
    """Scaled about it, a nearly flat one is the same, smaller: where photos are in reversed order, too."""
    made = relief_scene(160, 120, 3, held_out=0, steps=0)
    views = [replace(view, image=other.image) for view, other in zip(made.views, made.views[::-1])]
    reasons = likely_reasons(views, [made.initial_depth(camera) for camera in made.cameras])
    assert reasons and "paired rightly" in reasons[0]


def test_a_mesh_too_small_to_show_is_named(made, device):
    vertices, faces = made.initial_mesh()
    with pytest.raises(InputError, match="no view has a depth map .*is it in another unit than the cameras"):
        refine_mesh((vertices / 1000, faces), made.cameras, [view.image for view in made.views], device=device,
                    preset="fast")


def moved(pose, shift):
    """A pose in a world that has gone by `shift`."""
    pose = pose.copy()
    pose[:3, 3] -= pose[:3, :3] @ shift
    return pose


def test_nothing_is_blamed_where_all_is_right(given):
    assert likely_reasons(*given) == []


@pytest.mark.parametrize("mistake", ["black photos", "inverted masks", "millimetres"])
@pytest.mark.parametrize("kept", [False, True], ids=["memory", "folder"])
def test_python_is_warned(given, mistake, kept, tmp_path, device):
    spoil, reason = MISTAKES[mistake]
    views, depths = spoil(*given)
    with pytest.warns(NothingRefinedWarning, match=f"nothing was refined: 0 of .*{reason}") as caught:
        results = refine_views(views, depths, preset="fast", device=device, folder=tmp_path if kept else None)
    assert len([one for one in caught if one.category is NothingRefinedWarning]) == 1
    for result, depth in zip(results, depths):
        assert result.reason and result.counts["refined"] == 0 and np.array_equal(result.depth, depth)


def test_nobody_is_warned_of_a_run_that_refines(given, device):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        results = refine_views(*given, preset="fast", device=device)
    assert all(result.counts["refined"] > 0.9 * result.depth.size for result in results)


@pytest.mark.parametrize("preset", ["fast", "balanced"])
def test_refined_is_what_evidence_moved(given, device, preset):
    """Half of each photo is black: what lies far inside it stays, bit for bit; so does all that is not refined."""
    views, depths = given
    views = [replace(view, image=view.load_image() * (np.arange(96) >= 48)[None, :, None].astype(np.uint8))
             for view in views]
    result = refine_depth(views[0], views[1:], depths[0], preset=preset, device=device)
    refined = result.status == REFINED
    assert np.array_equal(refined, result.depth != depths[0])
    assert (result.status[:, :24] == KEPT).all() and np.isinf(result.deviation[:, :24]).all()
    assert refined[:, 72:].mean() > 0.9


@pytest.fixture(scope="module")
def spoilt(made, tmp_path_factory):
    """A scene on disk whose masks are inverted."""
    folder = write_scene(made, tmp_path_factory.mktemp("nothing") / "scene")
    (folder / "masks").mkdir()
    for photo in (folder / "images").iterdir():
        Image.fromarray(np.zeros((72, 96), np.uint8)).save(folder / "masks" / photo.name)
    return folder


@pytest.mark.parametrize("way", ["depth maps", "mesh", "same mesh", "script"])
def test_every_command_says_so_and_ends_with_status_3(spoilt, tmp_path, capsys, way):
    if way != "depth maps":
        pytest.importorskip("open3d")
    mesh = ["--mesh", str(spoilt / "mesh_coarse.ply"), "--output", str(tmp_path / "fine.ply")]
    commands = {"depth maps": ["refine", str(spoilt), "--depth-dir", str(spoilt / "depth_initial"), "--save-depth",
                            str(tmp_path / "out")],
             "mesh": ["refine", str(spoilt), *mesh, "--report", str(tmp_path / "page")],
             "same mesh": ["refine", str(spoilt), *mesh, "--keep-mesh"]}
    if way == "script":
        pytest.importorskip("pymeshlab")
        (tmp_path / "s.mlx").write_text('<!DOCTYPE FilterScript>\n<FilterScript><filter name="PAGaS Depth Refinement">'
                                        '<Param type="RichString" name="preset" value="fast"/></filter></FilterScript>')
        commands[way] = ["script", str(tmp_path / "s.mlx"), str(spoilt), *mesh]
    fast = [] if way == "script" else ["--preset", "fast"]
    assert command_line.run([*commands[way], "--quiet", *fast]) == 3
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith("pagas-cl: NOTHING WAS REFINED: 0 of ") and "masks leave 0.0%" in last
    if way == "mesh":
        page = (tmp_path / "page" / "index.html").read_text()
        assert "Nothing was refined: " in page and "masks leave 0.0%" in page
    assert (tmp_path / ("out/target.npz" if way == "depth maps" else "fine.ply")).is_file()


def test_no_line_of_the_summary_is_empty(spoilt, tmp_path, capsys):
    assert command_line.run(["refine", str(spoilt), "--depth-dir", str(spoilt / "depth_initial"), "--save-depth",
                             str(tmp_path / "out"), "--preset", "fast"]) == 3
    lines = capsys.readouterr().err.splitlines()
    assert "INFO the refined depth maps:" in "\n".join(lines) and "INFO" not in [line.strip() for line in lines]
