"""Every example in tests/examples (the README shows them) runs as it is, in a folder with scenes of each kind."""

from pathlib import Path

import pytest
from PIL import Image
from support.example_scenes import write_example
from support.scenes import relief_scene
from support.synthetic.scene import write_scene

from pagas_cl.scene.mesh import Surface
from pagas_cl.scene.meshes.files import write_mesh
from pagas_cl.scene.view import View

pytestmark = pytest.mark.slow

EXAMPLES = sorted((Path(__file__).parent / "examples").glob("*.py"))
NEEDS = {"pymeshlab_method": ["pymeshlab", "open3d"], "filter_script": ["pymeshlab", "open3d"], "depth_maps": [],
         "other_formats": [], "feed_forward": [], "own_queue": []}
MIXED = """<!DOCTYPE FilterScript>
<FilterScript>
 <filter name="Remove Duplicate Vertices"/>
 <filter name="PAGaS Depth Refinement"/>
 <filter name="Remove Unreferenced Vertices"/>
</FilterScript>
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """SCENE, DEPTH, RGBD, NERFSTUDIO, MVSNET, NEUS, BUNDLER, a 2DGS output and a script."""
    from support import scene_writers as to

    from pagas_cl.scene.depthmap import resize_depth, save_depth

    folder = tmp_path_factory.mktemp("examples")
    made = relief_scene(64, 48, 2, held_out=0)
    write_scene(made, folder / "SCENE")
    (folder / "mixed.mlx").write_text(MIXED)
    (folder / "train" / "iterations_30000").mkdir(parents=True)
    write_mesh(folder / "train" / "iterations_30000" / "fuse_post.ply", Surface(*made.initial_mesh()))
    for camera in made.cameras[:3]:
        save_depth(folder / "DEPTH" / f"{camera.name}.npz", resize_depth(made.initial_depth(camera), 40, 30))
    cameras = made.cameras[:3]
    for kind, write, place in (("NERFSTUDIO", to.nerfstudio, "images"), ("MVSNET", to.mvsnet, "images"),
                               ("NEUS", to.neus, "image"), ("BUNDLER", to.bundler, "images")):
        write(folder / kind, _photos(folder / kind / place, made, cameras, centred=kind == "BUNDLER"))
    write_example(folder / "RGBD", "open3d", relief_scene(64, 48, 4, held_out=0))
    write_example(folder / "DA3", "da3", made)
    return folder


def _photos(place, made, cameras, centred):
    from dataclasses import replace

    place.mkdir(parents=True)
    views = []
    for k, camera in enumerate(cameras):
        Image.fromarray(made.views[k].image).save(place / f"{k:08d}.png")
        if centred:
            camera = replace(camera, cx=camera.width / 2, cy=camera.height / 2, fy=camera.fx)
        views.append(View(camera, place / f"{k:08d}.png", None, f"{k:08d}.png"))
    return views


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_example_runs(path, folder, monkeypatch):
    for package in NEEDS.get(path.stem, ["open3d"]):
        pytest.importorskip(package)
    monkeypatch.chdir(folder)
    text = path.read_text()
    assert len(text.splitlines()) <= 12
    (folder / "fine.ply").unlink(missing_ok=True)
    names = {}
    exec(compile(text, str(path), "exec"), names)
    if '"fine.ply"' in text:
        from pagas_cl.scene.meshes.files import read_mesh

        assert len(read_mesh(folder / "fine.ply").faces) > 100
    if path.stem == "check_cameras":
        assert names["report"].ok
    if path.stem == "meshlab_project":
        assert len(names["again"].views) == 3
    if path.stem == "pymeshlab_method":
        from pagas_cl.filters.filter_script import check_script

        assert len(check_script("all_three_steps.mlx")) == 3
    if path.stem == "feed_forward":
        assert [len(said) > 80 for said in names["scales"].said] and (folder / "refined" / "000002.npz").is_file()
    if path.stem == "depth_maps":
        assert len(list(Path("refined").glob("*.npz"))) == 3


def test_a_view_without_a_depth_map_does_not_move_the_names_of_others(folder, tmp_path, monkeypatch):
    (tmp_path / "SCENE").symlink_to(folder / "SCENE")
    (tmp_path / "DEPTH").mkdir()
    files = sorted((folder / "DEPTH").glob("*.npz"))[:-1]       # the target, which comes first, has none
    for file in files:
        (tmp_path / "DEPTH" / file.name).symlink_to(file)
    monkeypatch.chdir(tmp_path)
    exec(compile((Path(__file__).parent / "examples" / "depth_maps.py").read_text(), "depth_maps", "exec"), {})
    assert [file.name for file in files] == sorted(file.name for file in Path("refined").glob("*.npz"))
