"""What other reconstructors write goes in as it lies: 2DGS, PGSR, MVSAnywhere, COLMAP MVS, OpenMVS."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from support.job_scenes import NOT_MEASURED
from support.scenes import relief_scene

from pagas_cl.__main__ import run
from pagas_cl.scene.depthmap import find_depth, load_depth, resize_depth
from pagas_cl.scene.mesh import Surface
from pagas_cl.scene.meshes.files import write_mesh

pytestmark = pytest.mark.slow

pytest.importorskip("open3d")
pytest.importorskip("pycolmap")
FEW = ["--set", "pyramid.scales=1", "pyramid.steps=8", "--quiet", *NOT_MEASURED[1:]]      # but aligned in scale


@pytest.fixture(scope="module")
def made():
    return relief_scene(64, 48, contexts=2, held_out=0, steps=0)


@pytest.fixture
def scene(made, tmp_path):
    """A COLMAP workspace: images/ and sparse/0, as 2DGS, PGSR and COLMAP's dense step share it."""
    from test_readers_colmap import write_model

    cameras = [replace(camera, name=f"{k:04d}.png") for k, camera in enumerate(made.cameras[:3])]
    write_model(tmp_path, cameras, photos=False)
    (tmp_path / "images").mkdir()
    for camera, view in zip(cameras, made.views):
        Image.fromarray(view.image).save(tmp_path / "images" / camera.name)
    return tmp_path


MESHES = {
    "2DGS": "output/train/ours_30000/fuse_post.ply",
    "PGSR": "output/mesh/tsdf_fusion_post.ply",
    "COLMAP Poisson": "dense/meshed-poisson.ply",
    "COLMAP Delaunay": "dense/meshed-delaunay.ply",
    "OpenMVS": "scene_dense_mesh.ply",
}


@pytest.mark.parametrize("name", MESHES)
def test_mesh_goes_in(name, scene, made):
    mesh = scene / MESHES[name]
    mesh.parent.mkdir(parents=True, exist_ok=True)
    write_mesh(mesh, Surface(*made.initial_mesh()))
    if name in ("2DGS", "OpenMVS"):  # 2DGS writes colours, OpenMVS float vertices: through Open3D
        import open3d as o3d

        read = o3d.io.read_triangle_mesh(str(mesh))
        read.paint_uniform_color([0.5, 0.2, 0.1])
        o3d.io.write_triangle_mesh(str(mesh), read)
    assert run(["refine", str(scene), "--mesh", str(mesh), "--output", str(scene / "fine.ply"), *FEW]) == 0
    assert (scene / "fine.ply").stat().st_size > 5000


def write_pfm(path, depth):
    path.write_bytes(b"Pf\n%d %d\n-1.0\n" % depth.shape[::-1] + np.ascontiguousarray(depth[::-1], "<f4").tobytes())


def write_colmap(path, depth):
    path.write_bytes(b"%d&%d&1&" % depth.shape[::-1] + np.ascontiguousarray(depth, "<f4").tobytes())


DEPTHS = {  # where they lie, how they are written, options
    "MVSAnywhere": ("mvsanywhere", ".npy", lambda path, depth: np.save(path, depth), []),
    "COLMAP MVS": ("dense/stereo/depth_maps", ".png.geometric.bin", write_colmap, []),
    "COLMAP photometric": ("dense/stereo/depth_maps", ".png.photometric.bin", write_colmap, []),
    "MVSNet": ("depth_est", ".pfm", write_pfm, []),
    "RGB-D": ("depth", ".png", lambda path, depth: Image.fromarray(np.rint(depth * 50).astype(np.uint16)).save(path),
              ["--depth-scale", "50"]),
}


@pytest.mark.parametrize("name", DEPTHS)
def test_depth_maps_of_another_size_go_in(name, scene, made):
    """Of half the photo's size, with a hole: upsampled with validity kept."""
    place, suffix, write, options = DEPTHS[name]
    folder = scene / place
    folder.mkdir(parents=True)
    for k, camera in enumerate(made.cameras[:3]):
        depth = resize_depth(made.initial_depth(camera), 32, 24)
        depth[5:9, 10:16] = 0
        write(folder / f"{k:04d}{suffix}", depth)
    found = load_depth(find_depth(folder, "0001.png"), (64, 48), scale=float(options[1]) if options else None)
    assert (found[10:18, 20:32] == 0).all() and (found == 0).sum() == 8 * 12
    truth = made.initial_depth(made.cameras[1])
    assert np.median(np.abs(found - truth)[found > 0]) < 0.02 * np.ptp(truth)
    out = scene / "refined"
    assert run(["refine", str(scene), "--depth-dir", str(folder), "--save-depth", str(out), *options, *FEW]) == 0
    for k in range(3):
        refined = np.load(out / f"{k:04d}.npz")["depth"]
        assert refined.shape == (48, 64) and (refined[10:18, 20:32] == 0).all() and (refined > 0).sum() == 48 * 64 - 96


def test_real_openmvs_mesh_and_cameras(data_dir):
    """The castle: OpenMVS's own mesh is where its cameras look."""
    from pagas_cl.scene.check.cameras import check_cameras
    from pagas_cl.scene.readers import read_scene

    scene = read_scene(data_dir / "sceaux_castle")
    report = check_cameras(data_dir / "sceaux_castle" / "scene_mesh.ply", scene.cameras)
    assert report.ok and "10 of 10 cameras see the mesh" in report.sentence


def test_five_steps_on_the_real_castle(data_dir, tmp_path):
    """A mixed script on a real project: photos at a twelfth of their size, OpenMVS's mesh, our step in the middle."""
    pymeshlab = pytest.importorskip("pymeshlab")
    from test_filter_script import FIVE, script

    from pagas_cl.filters.filter_script import check_script
    from pagas_cl.scene.readers import read_scene
    from pagas_cl.scene.readers.meshlab import MeshLayer, read_project, write_project
    from pagas_cl.scene.view import View

    views = []
    for view in read_scene(data_dir / "sceaux_castle").views[2:6]:
        path = tmp_path / f"{view.stem}.png"
        with Image.open(view.image) as photo:
            photo.draft("RGB", (354, 266))
            photo.resize((236, 177), Image.BOX).save(path)
        views.append(View(replace(view.camera.resized(236, 177), name=path.name), path, None, path.name))
    mesh = tmp_path / "scene_mesh.ply"
    mesh.write_bytes((data_dir / "sceaux_castle" / "scene_mesh.ply").read_bytes())
    project = write_project(tmp_path / "castle.mlp", views, [MeshLayer("castle", mesh, np.eye(4))])
    arguments = ["--project", str(project), "--output", str(tmp_path / "out.mlp"), "--quiet"]
    assert run(["script", str(script(tmp_path, FIVE)), *arguments, "--save-script", str(tmp_path / "saved.mlx")]) == 0
    layers = read_project(tmp_path / "out.mlp").meshes
    assert [layer.label for layer in layers] == ["castle", "castle refined"]
    meshes = pymeshlab.MeshSet()
    meshes.load_new_mesh(str(layers[1].path))
    assert meshes.current_mesh().face_number() > 3000
    assert len(check_script(tmp_path / "saved.mlx")) == 5  # saved by pymeshlab, and it loads again
