"""Pipes, devices and files without an end, in every place that a scene, depth maps or finished views have files in:
refused or passed over, at once and in little memory."""

import os
import shutil
import sys

import numpy as np
import pytest
from support import rigs, scene_writers
from support.fuzzing import bounded
from support.job_scenes import write_small_scene

from pagas_cl.errors import InputError, PagasError
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.depthmap import SUFFIXES, find_depth, load_depth
from pagas_cl.scene.readers import FORMATS, read_scene
from pagas_cl.scene.view import View
from pagas_cl.system.files import digest_file, read_bytes

pytestmark = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no named pipes here")
LINKS = {"pipe": os.mkfifo, "zeros": lambda path: path.symlink_to("/dev/zero"),
         "loop": lambda path: path.symlink_to(path), "folder": lambda path: path.mkdir(),
         "system": lambda path: path.symlink_to("/proc/self/environ")}
NAMES = [*(f"sparse/0/{part}.{kind}" for part in ("cameras", "images", "points3D") for kind in ("bin", "txt")),
         "transforms.json", "transforms_train.json", "cameras.npz", "cameras_sphere.npz", "trajectory.json",
         "trajectory.log", "bundle.out", "list.txt", "scene.mlp", "cams/00000000_cam.txt", "images/0.png"]


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """Scenes of some formats."""
    folder = tmp_path_factory.mktemp("pipes")
    write_small_scene(folder / "cameras", 2)
    for name in ("nerfstudio", "mvsnet"):
        (folder / name).mkdir()
        getattr(scene_writers, name)(folder / name, rigs.with_photos(folder / name, rigs.random_cameras(2)))
    for name in NAMES:       # and a folder with a file of every name that readers look for
        (folder / "names" / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / "names" / name).write_bytes(b"")
    return folder


@pytest.mark.parametrize("kind", LINKS)
def test_no_file_of_a_scene_is_waited_for(scenes, tmp_path, kind):
    """Each file of each scene in turn, read by every reader."""
    for original in sorted(scenes.iterdir()):
        for file in [path.relative_to(original) for path in sorted(original.rglob("*")) if path.is_file()]:
            if file.parts[0].startswith("depth"):
                continue
            scene = tmp_path / "scene"
            shutil.copytree(original, scene)
            (scene / file).unlink()
            LINKS[kind](scene / file)
            with bounded(more_bytes=1 << 30):
                for name in (None, *FORMATS):
                    try:
                        for view in read_scene(scene, name).views:
                            view.load_image()
                    except InputError:
                        pass
            shutil.rmtree(scene)


@pytest.mark.parametrize("kind", LINKS)
def test_no_depth_map_photo_or_list_of_points_is_waited_for(tmp_path, kind):
    from support.clouds import load_points

    camera = Camera(4, 4, 4, 4, 2, 2, np.eye(4), "a.png")
    for suffix in (*SUFFIXES, ".xyz", ".ply"):
        path = tmp_path / f"a{suffix}"
        LINKS[kind](path)
        assert suffix == ".png" or find_depth(tmp_path, "a.jpg") is None or kind == "system"
        for read in (load_depth, load_points, digest_file, read_bytes, lambda path: View(camera, path).load_image()):
            with bounded(more_bytes=1 << 30), pytest.raises((PagasError, OSError)):
                read(path)
                if kind == "system":
                    raise InputError("read, in little memory")
        (shutil.rmtree if path.is_dir() and not path.is_symlink() else os.unlink)(path)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:nothing was refined")
def test_a_run_does_not_wait_for_pipes_among_its_finished_views(tmp_path):
    from support import job_scenes as work

    from pagas_cl.jobs import refine_all

    views, depths = work.load_small_scene(write_small_scene(tmp_path / "scene", 4))
    out = tmp_path / "out"

    def run():
        return refine_all(work.copy_depth, views, depths, range(4), work.QUICK, folder=out)

    run()
    whole = work.bytes_of(out)
    for name in ("target.npz", ".pagas_cl/views/context_00.npz", ".pagas_cl/views/context_01.json",
                 ".pagas_cl/names.json"):
        (out / name).unlink()
        os.mkfifo(out / name)
    with bounded(60):
        run()
    assert work.bytes_of(out) == whole and "linux" in sys.platform
