"""Where a mesh would have to be for the photos to agree: offset, scale and unit are found, and how sure that is."""

import numpy as np
import pytest
from support.scenes import relief_scene
from support.synthetic.scene import write_scene

import pagas_cl.__main__ as command_line
from pagas_cl.errors import InputError
from pagas_cl.scene.camera import Camera, rigid
from pagas_cl.scene.check.cameras import check_cameras, check_seen
from pagas_cl.scene.mesh import Surface, grid_faces
from pagas_cl.scene.meshes.files import write_mesh

pytestmark = pytest.mark.slow

# of the mesh, scene units (a pixel is about 2): x -> scale x + offset
WRONG = {"above": (1, (0, 0, -30)), "below and to the side": (1, (40, -25, 25)), "larger": (1.08, (0, 0, 45)),
         "millimetres": (1000, (0, 0, 0)), "metres": (0.001, (0, 0, 0)),
         "far away": (1, (5e5, 4e6, 0))}


@pytest.fixture(scope="module")
def scene():
    made = relief_scene(160, 120, contexts=3, held_out=0, base=40.0)
    return made, made.initial_mesh()


def check(scene, scale=1.0, offset=(0, 0, 0)):
    made, (vertices, faces) = scene
    return check_cameras((scale * vertices + np.asarray(offset, float), faces), made.cameras,
                         [view.image for view in made.views])


@pytest.mark.parametrize("name", WRONG)
def test_what_would_agree_is_found(scene, name):
    made, (vertices, _) = scene
    scale, offset = WRONG[name]
    report = check(scene, scale, offset)
    assert not report.ok and report.fit.apart and report.fit.agreement > 0.9
    assert ("do not fit together" in report.sentence) == (report.readings[0].seeing > 0) and "sure: " in report.sentence
    assert "not judged" in report.half_pixel and not any(r.better for r in report.readings)
    assert ("another unit" in report.sentence) == (scale in (1000, 0.001))
    # back on its place, but for sliding along the surface: the height is what shows
    back = report.fit.scale * (scale * vertices + np.asarray(offset, float)) + np.array(report.fit.offset)
    assert np.abs(np.median(back - vertices, axis=0))[2] < 3
    assert abs(report.fit.scale * scale - 1) < 0.02
    if name == "larger":
        moved = check(scene, report.fit.scale * scale, report.fit.scale * np.asarray(offset, float) + report.fit.offset)
        assert moved.ok, moved.sentence


def test_a_mesh_in_its_place_is_reported_so_and_how_sure(scene):
    report = check(scene)
    assert report.ok and not report.fit.apart and report.fit.pixels < 0.5
    assert "right as they are (sure: " in report.sentence
    few = check_cameras(scene[1], scene[0].cameras[:2], [view.image for view in scene[0].views[:2]])
    assert few.ok and "(not sure: " in few.sentence


@pytest.mark.parametrize("name", ["above", "millimetres"])
def test_the_command_says_it_with_status_2(scene, tmp_path, capsys, name):
    pytest.importorskip("open3d")
    folder = write_scene(scene[0], tmp_path / "scene")
    scale, offset = WRONG[name]
    vertices, faces = scene[1]
    write_mesh(tmp_path / "m.ply", Surface(scale * vertices + np.asarray(offset, float), faces))
    assert command_line.run(["check", str(folder), "--mesh", str(tmp_path / "m.ply")]) == 2
    last = capsys.readouterr().err.splitlines()[-1]
    assert ("scaled by 0.001 " if name == "millimetres" else "the mesh moved by (") in last


def test_refining_names_the_unit_too(scene):
    made, (vertices, faces) = scene
    with pytest.raises(InputError, match="with the mesh scaled by 0.001 4 of 4 do: is it in another unit"):
        check_seen(Surface(1000 * vertices, faces), made.cameras)


def strip(number, above=0.0):
    """Mesh, cameras and photos of a flight over the plane z = 0, a unit above it: each photo shows of the ground what
    the next few show alone. The mesh may lie `above` it."""
    texture = np.random.default_rng(0).normal(0, 1, (72, 96 + 24 * number))
    for axis in (0, 1):
        texture = np.apply_along_axis(np.convolve, axis, texture, np.exp(-np.arange(-7, 8)**2 / 6.5), "same")
    texture = np.clip(128 + 50 * texture / texture.std(), 0, 255).astype(np.uint8)
    photos = [np.dstack(3 * [texture[:, 24 * k:24 * k + 96]]) for k in range(number)]
    cameras = [Camera(96, 72, 100.0, 100.0, 48.0, 36.0, rigid(np.eye(3), [-0.24 * k, 0, 1.0])) for k in range(number)]
    across = 8 * number + 1
    x, y = np.meshgrid(np.linspace(-0.6, 0.24 * number + 0.6, across), np.linspace(-0.5, 0.5, 9))
    return (np.stack([x.ravel(), y.ravel(), np.full(x.size, -above)], 1), grid_faces(across, 9)), cameras, photos


def test_photos_of_a_long_strip_are_compared_where_they_overlap():
    """Ten of sixty, evenly chosen, have nothing in common."""
    report = check_cameras(*strip(60))
    assert report.ok and report.readings[0].agreement > 0.95 and len(report.views) == 60
    assert report.sentence.startswith("compared were 10 of 60 photos, '00025' to '00037': 10 of 10 cameras see the ")
    assert "right as they are (sure: " in report.sentence
    off = check_cameras(*strip(60, 0.15))
    assert not off.ok and off.fit.apart and "compared were 10 of 60 photos" in off.at_command_line[1]


def test_a_flat_mesh_that_is_off_is_not_turned_over():
    """Its mirror image, behind the ground, is off by fewer pixels."""
    report = check_cameras(*strip(8, 0.15))
    assert not report.ok and report.best == "as given"
    assert "do not fit together" in report.sentence and report.fit.agreement > 0.95
