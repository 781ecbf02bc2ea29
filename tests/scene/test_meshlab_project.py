"""MeshLab projects: written ones open in pymeshlab, pymeshlab's own are read, hostile ones are refused."""

from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from PIL import Image
from support import rigs
from support.scenes import relief_scene
from test_check_fit import strip

from pagas_cl.app.commands._given import look
from pagas_cl.errors import InputError
from pagas_cl.scene.mesh import Surface
from pagas_cl.scene.meshes.files import read_mesh, write_mesh
from pagas_cl.scene.readers import read_scene
from pagas_cl.scene.readers.meshlab import MeshLayer, read_project, resolve_flavour, write_project
from pagas_cl.scene.view import View

pytestmark = pytest.mark.slow

pymeshlab = pytest.importorskip("pymeshlab")


@pytest.fixture
def project(tmp_path) -> Path:
    """A project by pagas_cl: a moved mesh layer and two views."""
    views = rigs.with_photos(tmp_path, rigs.random_cameras(2))
    pymeshlab_save(tmp_path / "box.ply")
    matrix = np.array([[0, -2, 0, 1 / 3], [2, 0, 0, 0], [0, 0, 2, 1e6 + 1 / 7], [0, 0, 0, 1]])
    return write_project(tmp_path / "p.mlp", views, [MeshLayer("a \"box\" & more", tmp_path / "box.ply", matrix)])


def pymeshlab_save(path: Path):
    meshes = pymeshlab.MeshSet()
    meshes.create_cube()
    meshes.save_current_mesh(str(path))


def test_pymeshlab_opens_what_is_written(project):
    """Cameras as MeshLab understood them come back through its own project file, to its six digits."""
    own = read_project(project)
    meshes = pymeshlab.MeshSet()
    meshes.load_project(str(project))
    assert (meshes.mesh_number(), meshes.raster_number()) == (1, 2)
    # MeshLab reads layer matrices in single precision
    assert np.array_equal(meshes.current_mesh().transform_matrix(), own.meshes[0].matrix.astype(np.float32))
    again = project.parent / "again.mlp"
    meshes.save_project(str(again))
    theirs = read_project(again)
    assert theirs.meshes[0].path == own.meshes[0].path
    for a, b in zip(own.rasters, theirs.rasters):
        assert a.path == b.path
        a, b = a.camera(), b.camera()
        assert (a.width, a.height) == (b.width, b.height)
        assert abs(a.fx / b.fx - 1) < 1e-5 and abs(a.fy / b.fy - 1) < 1e-5
        assert np.abs(np.subtract((a.cx, a.cy), (b.cx, b.cy))).max() < 1e-3
        assert np.abs(a.world_to_camera - b.world_to_camera).max() < 1e-4


def test_meshlab_projects_as_we_do(project):
    """A filter of MeshLab that uses the camera without OpenGL agrees with pagas_cl's: depth along the view."""
    camera = read_project(project).rasters[-1].camera()
    meshes = pymeshlab.MeshSet()
    meshes.load_project(str(project))
    meshes.save_active_raster_cameras(exportfile="Agisoft xml", newname=str(project.parent / "cams"))
    text = (project.parent / "cams.xml").read_text()
    pose = np.array(text.split("<transform>")[-1].split("</transform>")[0].split(), float).reshape(4, 4)
    assert np.abs(np.abs(pose[:3, 3]) - np.abs(camera.center)).max() < 1e-3


def test_bundlers_file_as_meshlab_writes_it(tmp_path, caplog):
    """It ends in a line of zeros, and comes without a list of photos."""
    views = rigs.with_photos(tmp_path, rigs.random_cameras(3, centred=True, square=True))
    meshes = pymeshlab.MeshSet()
    meshes.load_project(str(write_project(tmp_path / "p.mlp", views)))
    meshes.save_active_raster_cameras(exportfile="Bundler .out", newname=str(tmp_path / "bundle"))
    scene = read_scene(tmp_path, "bundler")
    assert max(rigs.worst_difference(*pair) for pair in zip((view.camera for view in scene.views),
                                                            (view.camera for view in views))) < 2e-4
    assert "bundle.out names no photos: they are taken in the order of their names" in caplog.text
    with open(tmp_path / "bundle.out", "a") as file:
        file.write("0 0 0\n")
    with pytest.raises(InputError, match="has 18 lines, expected 16"):
        read_scene(tmp_path, "bundler")


def test_large_translations_keep_their_digits(tmp_path):
    views = rigs.with_photos(tmp_path, rigs.random_cameras(2, offset=rigs.UTM))
    write_project(tmp_path / "p.mlp", views)
    for view, raster in zip(views, read_project(tmp_path / "p.mlp").rasters):
        assert np.abs(raster.camera().center - view.camera.center).max() < 5e-9 * 4.6


def test_positions_that_meshlab_rounds_too_far_are_logged(tmp_path, caplog):
    """MeshLab writes six digits of a position, 10 units of a northing; its own projects near 0 are fine."""
    for offset, said in ((rigs.UTM, True), (0, False)):
        write_project(tmp_path / "p.mlp", rigs.with_photos(tmp_path, rigs.random_cameras(2, offset=offset)))
        read_project(tmp_path / "p.mlp")
        assert "rounded" not in caplog.text
        meshes = pymeshlab.MeshSet()
        meshes.load_project(str(tmp_path / "p.mlp"))
        meshes.save_project(str(tmp_path / "again.mlp"))
        read_project(tmp_path / "again.mlp")
        assert ("positions of cameras are rounded to 10 units" in caplog.text) is said
        caplog.clear()


def test_openmvs_reading(project):
    raster = read_project(project).rasters[0]
    plain, other = raster.camera(), raster.camera("openmvs")
    assert abs(other.cx - plain.cx - 0.5) < 1e-9
    assert abs(other.cy - (plain.height - plain.cy + 0.5)) < 1e-9
    with pytest.raises(InputError, match="flavour is 'other'"):
        raster.camera("other")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A synthetic scene whose principal point is well off the middle, as a project with its mesh."""
    folder = tmp_path_factory.mktemp("synthetic")
    scene = relief_scene(160, 120, contexts=3, held_out=0)
    views = []
    for view in scene.views:
        path = folder / f"{view.camera.name}.png"
        Image.fromarray(np.roll(view.image, 9, axis=0)).save(path)
        views.append(View(replace(view.camera, cy=view.camera.cy + 9), path, None, path.name))
    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(*scene.initial_mesh()))
    meshes.save_current_mesh(str(folder / "mesh.ply"))
    meshes.add_mesh(pymeshlab.Mesh(scene.initial_mesh()[0]))
    meshes.save_current_mesh(str(folder / "cloud.ply"))
    return folder, views


@pytest.mark.parametrize("writer", ["meshlab", "openmvs"])
def test_the_reading_of_center_is_resolved_by_photos(made, writer, caplog):
    folder, views = made
    if writer == "openmvs":  # writes K(0,2) K(1,2), from the top, pixel centres at whole numbers
        stored = [replace(v, camera=replace(v.camera, cx=v.camera.cx - 0.5, cy=v.camera.height - v.camera.cy + 0.5))
                  for v in views]
    else:
        stored = views
    path = write_project(folder / f"{writer}.mlp", stored, [MeshLayer("sparse", folder / "cloud.ply", np.eye(4)),
                                                            MeshLayer("mesh", folder / "mesh.ply", np.eye(4))])
    flavour, reason = resolve_flavour(read_project(path))
    assert flavour == writer
    assert "the photos prefer it" in reason if writer == "openmvs" else "the photos agree" in reason
    with caplog.at_level("INFO", logger="pagas_cl"):
        scene = read_scene(path, "meshlab")
    assert reason in caplog.text
    assert all(rigs.worst_difference(a.camera, b.camera) < 1e-9 for a, b in zip(views, scene.views))


def test_the_reading_of_center_in_a_long_strip(tmp_path):
    """Eight of sixty photos, evenly chosen, have nothing in common."""
    (vertices, faces), cameras, photos = strip(60)
    write_mesh(tmp_path / "mesh.ply", Surface(vertices, faces))
    views = []
    for k, (camera, photo) in enumerate(zip(cameras, photos)):
        if k % 2:       # upside down: over a plane the same shift of all photos would show nowhere
            photo = photo[::-1, ::-1]
            camera = replace(camera, world_to_camera=np.diag([-1.0, -1, 1, 1]) @ camera.world_to_camera)
        Image.fromarray(photo[12:]).save(tmp_path / f"{k}.png")      # cut at the top, and stored as OpenMVS does
        views.append(View(replace(camera, height=60, cy=60 - 23.5, cx=47.5), tmp_path / f"{k}.png", name=f"{k}.png"))
    write_project(tmp_path / "p.mlp", views, [MeshLayer("mesh", tmp_path / "mesh.ply", np.eye(4))])
    assert resolve_flavour(read_project(tmp_path / "p.mlp"))[0] == "openmvs"


def test_without_a_mesh_the_reading_is_logged(project, caplog):
    text = project.read_text()
    project.write_text(text[:text.index("  <MLMesh")] + text[text.index(" </MeshGroup>"):])
    flavour, reason = resolve_flavour(read_project(project))
    assert flavour == "meshlab" and "no mesh layer" in reason and "from the bottom" in reason


def test_its_one_mesh_is_the_surface(project, caplog):
    """Of several layers the visible one that no run has written, unless a matrix moves it."""
    place, views = project.parent / "one.mlp", read_project(project).scene().views
    box, own, moved = project.parent / "box.ply", project.parent / "fine.ply", np.diag([2.0, 2, 2, 1])
    write_mesh(own, read_mesh(box))

    def found(*layers):
        return look(write_project(place, views, layers), format="meshlab").mesh

    one, hidden, written = MeshLayer("a", box, np.eye(4)), MeshLayer("b", box, np.eye(4), False), \
        MeshLayer("c", own, np.eye(4))
    assert found(one) == found(hidden, one, written) == box and found(written) == own
    gone = replace(one, path=place.with_name("gone.ply"))
    assert found() is found(hidden) is found(one, one) is found(gone) is None
    with caplog.at_level("INFO", "pagas_cl"):
        assert found(replace(one, matrix=moved)) is found(one, one) is None
    assert "none of its 2 visible mesh layers is taken as the surface: hide all but one" in caplog.text
    assert "mesh layer 'a' is not taken as the surface, since a matrix moves it" in caplog.text


def test_entities_are_not_expanded(tmp_path):
    lol = "".join(f'<!ENTITY l{i + 1} "{f"&l{i};" * 10}">' for i in range(9))
    for declared in ('<!ENTITY l0 "ha">' + lol, '<!ENTITY l9 SYSTEM "file:///etc/passwd">',
                     '<!ENTITY % p SYSTEM "file:///etc/passwd"> %p;'):
        (tmp_path / "p.mlp").write_text(f"<!DOCTYPE MeshLabDocument [{declared}]><MeshLabProject>&l9;</MeshLabProject>")
        with pytest.raises(InputError, match="declares XML entities"):
            read_project(tmp_path / "p.mlp")


@pytest.mark.parametrize("standalone", [False, True])
@pytest.mark.parametrize("place", ['label="', 'FocalMm="', "<MeshGroup>"])
def test_an_entity_of_another_file_is_never_left_out_without_a_word(project, place, standalone):
    text = project.read_text()
    assert place in text and "<!DOCTYPE MeshLabDocument>" in text
    text = text.replace("<!DOCTYPE MeshLabDocument>", '<!DOCTYPE MeshLabDocument SYSTEM "http://127.0.0.1:9/x.dtd">')
    head = '<?xml version="1.0" standalone="yes"?>' if standalone else ""
    project.write_text(head + text.replace(place, f"{place}&unknown;", 1))
    with pytest.raises(InputError, match="undefined entity" if standalone else "names a file that may, in its DOCTYPE"):
        read_project(project)


def test_paths_stay_in_the_folder_unless_allowed(project, monkeypatch):
    text = project.read_text()
    name = 'fileName="images/00000000.png"'
    assert name in text
    for hostile in ("/etc/passwd", "../../secret.png", "images/../../x.png", "C:\\x.png", "\\\\host\\x.png", ""):
        project.write_text(text.replace(name, f'fileName="{hostile}"'))
        with pytest.raises(InputError, match="leads out of|expected the path"):
            read_project(project)
    project.write_text(text.replace(name, f'fileName="{project.absolute().parent}/images/00000000.png"'))
    assert read_project(project).scene().views[0].name == "00000000.png"
    moved = project.parent.parent / "moved.png"
    (project.parent / "images" / "00000000.png").rename(moved)
    project.write_text(text.replace(name, 'fileName="../moved.png"'))
    monkeypatch.setattr("os.path.relpath", Mock(side_effect=ValueError))      # as of another drive, on Windows
    assert read_project(project, outside=True).scene().views[0].load_image().shape == (48, 64, 3)


@pytest.mark.parametrize("old, new, sentence", [
    ("LensDistortion=\"0.0 0.0\"", "LensDistortion=\"0.1 0\"", "undistorted first"),
    ("CameraType=\"0\"", "CameraType=\"1\"", "expected 0 .perspective"),
    ("BinaryData=\"0\"", "BinaryData=\"1\"", "stored as binary"),
    ("FocalMm=", "Focal=", "FocalMm is None, expected 1 numbers"),
    ("PixelSizeMm=\"1.0", "PixelSizeMm=\"0.0", "expected numbers above 0"),
    ("ViewportPx=\"64 48\"", "ViewportPx=\"64.5 48\"", "whole number"),
    ("ViewportPx=\"64 48\"", "ViewportPx=\"32 24\"", "is 64 x 48, its camera says 32 x 24"),
    ("RotationMatrix=\"", "RotationMatrix=\"7", "rotation|form that MeshLab"),
    ("<MeshLabProject>", "<Other>", "not valid XML|expected <MeshLabProject>"),
])
def test_what_cannot_be_read_is_said(project, old, new, sentence):
    assert old in project.read_text()
    project.write_text(project.read_text().replace(old, new))
    with pytest.raises(InputError, match=sentence):
        read_project(project).scene()


def test_missing_photo_and_array_photo(project, tmp_path):
    (project.parent / "images" / "00000001.png").unlink()
    with pytest.raises(InputError, match="there is no file"):
        read_scene(project, "meshlab", flavour="meshlab")
    camera = rigs.random_cameras(1)[0]
    with pytest.raises(InputError, match="save it first"):
        write_project(tmp_path / "q.mlp", [View(camera, np.zeros((48, 64, 3), np.uint8), None, "a")])
