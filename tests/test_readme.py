"""The README's examples run as they are printed, on a made scene."""

import re
from pathlib import Path

import numpy as np
import pytest

import pagas_cl

README = Path(__file__).resolve().parent.parent / "README.md"
BLOCKS = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), flags=re.DOTALL)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    from pagas_cl.made import relief_scene
    from pagas_cl.made.disk import write_scene

    folder = tmp_path_factory.mktemp("readme")
    write_scene(relief_scene(64, 48, 2, held_out=0), folder / "SCENE")
    return folder


def run(block, folder, monkeypatch):
    monkeypatch.chdir(folder)
    names = {}
    exec(compile(block, str(README), "exec"), names)
    return names


def test_examples_are_short():
    assert len(BLOCKS) >= 3 and all(len(block.splitlines()) <= 12 for block in BLOCKS)


@pytest.mark.parametrize("words, packages", [("o3d.io.write_triangle_mesh", ["open3d"]),
                                             ("pymeshlab.MeshSet", ["open3d", "pymeshlab"])])
def test_example_writes_a_finer_mesh(words, packages, folder, monkeypatch):
    for package in packages:
        pytest.importorskip(package)
    from pagas_cl.scene.mesh import read_mesh

    (block,) = [block for block in BLOCKS if words in block]
    (folder / "fine.ply").unlink(missing_ok=True)
    run(block, folder, monkeypatch)
    assert len(read_mesh(folder / "fine.ply").faces) > 100


def test_example_refines_an_rgbd_frame(folder, monkeypatch):
    o3d = pytest.importorskip("open3d")
    (block,) = [block for block in BLOCKS if "RGBDImage" in block]
    refined = run(block, folder, monkeypatch)["refined"]
    target, *others = pagas_cl.read_scene(folder / "SCENE").views
    depth = np.load(folder / "SCENE" / "depth_initial" / f"{target.stem}.npz")["depth"]
    frame = o3d.geometry.RGBDImage.create_from_color_and_depth(
        o3d.geometry.Image(np.ascontiguousarray(target.load_image())), o3d.geometry.Image(depth), depth_scale=1.0,
        depth_trunc=1e9, convert_rgb_to_intensity=False)
    new = np.asarray(refined(target, others, frame).depth)
    assert new.shape == depth.shape and ((new > 0) == (depth > 0)).all() and (new != depth).any()


def test_every_command_named_exists():
    from pagas_cl.__main__ import command_names

    named = set(re.findall(r"^\s+pagas-cl (\w+)", README.read_text(encoding="utf-8"), flags=re.MULTILINE))
    assert named and named <= set(command_names())
