"""Damaged files next to the cameras, whole COLMAP models, and filter scripts; see test_fuzz_readers."""

import numpy as np
import pytest
from support import mutations, rigs, scene_writers
from support.fuzzing import COUNT, bounded
from support.scene_files import make_colmap, make_log

from pagas_cl.errors import InputError
from pagas_cl.scene.readers import read_scene


@pytest.mark.parametrize("binary", [True, False])
def test_all_files_of_a_colmap_model_damaged(tmp_path, binary):
    """Cameras and points too: refused, or read as the undamaged images with other intrinsics."""
    views = rigs.with_photos(tmp_path, rigs.random_cameras(3, same=True))
    make_colmap(tmp_path, views, binary)
    place = tmp_path / "sparse/0"
    before, rng, read = read_scene(tmp_path, "colmap"), np.random.default_rng(5), 0
    for part in ("cameras", "points3D"):
        path = place / (part + (".bin" if binary else ".txt"))
        original = path.read_bytes()
        for _ in range(COUNT // 2):
            path.write_bytes(mutations.mutate(original, rng))
            try:
                with bounded():
                    scene = read_scene(tmp_path, "colmap")
            except InputError:
                continue
            read += 1
            for a, b in zip(before.cameras, scene.cameras, strict=True):
                assert np.array_equal(a.world_to_camera, b.world_to_camera) and (b.width, b.height) == (64, 48)
        path.write_bytes(original)
    assert read


@pytest.mark.parametrize("name, make, side", [
    ("bundler", scene_writers.bundler, "list.txt"),
    ("open3d", make_log, "camera_intrinsic.json")])
def test_damaged_files_next_to_the_cameras(tmp_path, name, make, side):
    """Lists and intrinsics: refused, or the poses are those of the photos that are named."""
    views = rigs.with_photos(tmp_path, rigs.random_cameras(3, same=True, centred=True, square=True))
    make(tmp_path, views)
    path = tmp_path / side
    poses = {view.name: view.camera.world_to_camera for view in views}
    order = list(poses)
    original, rng, read = path.read_bytes(), np.random.default_rng(9), 0
    for _ in range(COUNT):
        path.write_bytes(mutations.mutate(original, rng))
        try:
            with bounded():
                scene = read_scene(tmp_path, name)
        except InputError:
            continue
        read += 1
        for row, view in enumerate(scene.views):
            pose = poses[order[row] if name == "bundler" else view.name]
            assert np.abs(view.camera.world_to_camera - pose).max() < 1e-9
    assert 0 < read < COUNT


def test_damaged_filter_scripts(tmp_path, monkeypatch):
    """A script is refused, or every step of it is one that is known."""
    from importlib.resources import files

    pytest.importorskip("pymeshlab")
    from pagas_cl.filters import filter_script, native

    smooth = native.Known(True, {"stepSmoothNum": "RichInt", "Boundary": "RichBool"}, {})
    monkeypatch.setattr(native, "look_up", lambda names: {n: smooth if n == "Laplacian Smooth" else native.Known(False)
                                                          for n in names})
    monkeypatch.setattr(native, "nearest", lambda name: "Laplacian Smooth")
    script = (files("pagas_cl.filters") / "refine.mlx").read_text()
    path = tmp_path / "s.mlx"
    original = script.replace("<FilterScript>", '<FilterScript><filter name="Laplacian Smooth"><Param type="RichInt" '
                            'name="stepSmoothNum" value="3"/></filter>').encode()
    rng, read = np.random.default_rng(4), 0
    for _ in range(COUNT):
        path.write_bytes(mutations.mutate(original, rng))
        try:
            with bounded():
                steps = filter_script.check_script(path)
        except InputError:
            continue
        read += 1
        for step in steps:
            assert step.name in ("Laplacian Smooth", "PAGaS Depth Refinement")
            assert (step.request is None) == (step.name == "Laplacian Smooth")
    assert 0 < read < COUNT
