"""Fusion in boxes: the same triangles as from one grid, bit for bit, in a quarter of its memory."""

import json
import multiprocessing
import pickle
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from conftest import look_at, plane_depth

o3d = pytest.importorskip("open3d")

from pagas_cl.config import Fusion  # noqa: E402
from pagas_cl.errors import InputError  # noqa: E402
from pagas_cl.jobs.fusing import fuse_results  # noqa: E402
from pagas_cl.jobs.place import Place  # noqa: E402
from pagas_cl.method.surface import blocks  # noqa: E402
from pagas_cl.method.surface.blocks import BlockFiles, cut, fuse_within, within  # noqa: E402
from pagas_cl.method.surface.fuse import FusionPlan, fuse, fusion_plan, grid_mb, plan_with_blocks  # noqa: E402
from pagas_cl.progress import progress_of  # noqa: E402
from pagas_cl.scene.depthmap import save_depth  # noqa: E402
from pagas_cl.scene.view import View  # noqa: E402

pytestmark = pytest.mark.slow

NORMAL = np.array([0.3, 0.2, -0.93]) / np.linalg.norm([0.3, 0.2, -0.93])
SETTINGS = Fusion(voxel=1.0, truncation=6.0, min_component=0.01)


def rough_views(cameras, seed=0, rough=0.003):
    """Photos and depth maps of a rough, tilted plane with holes and a few flecks in front of it."""
    rng, views, depths = np.random.default_rng(seed), [], []
    for camera in cameras:
        depth = plane_depth(camera, NORMAL, 0)
        depth *= (1 + rough * rng.standard_normal(depth.shape)).astype(np.float32)
        depth[rng.random(depth.shape) < 0.05] = 0
        depth[20:24, 30:34] = 2.0
        image = rng.integers(0, 255, (camera.height, camera.width, 3), np.uint8)
        views.append(View(camera, image, None, camera.name))
        depths.append(depth)
    return views, depths


def sorted_mesh(mesh):
    """Vertices, normals, colours and faces in an order of their own."""
    order = np.lexsort(mesh.vertices.T)
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    faces = rank[mesh.faces]
    faces = np.take_along_axis(faces, (faces.argmin(axis=1)[:, None] + np.arange(3)) % 3, axis=1)
    return mesh.vertices[order], mesh.normals[order], mesh.colors[order], faces[np.lexsort(faces.T)]


def assert_same(mesh, other):
    for name, a, b in zip(("vertices", "normals", "colours", "faces"), sorted_mesh(mesh), sorted_mesh(other)):
        assert a.shape == b.shape and np.array_equal(a, b), name


@pytest.fixture(scope="module")
def scene():
    angles = np.radians(np.linspace(-18, 18, 3))
    return rough_views([look_at((4 * np.sin(a), 0.3 * np.cos(5 * a), -4 * np.cos(a)), (0, 0, 0), name=f"view{i}.png")
                        for i, a in enumerate(angles)])


@pytest.mark.parametrize("share", [0.5, 0.25])
def test_boxes_give_the_mesh_of_one_grid_bit_for_bit(scene, share, caplog):
    views, depths = scene
    plan, caplog.handler.level = fusion_plan(views, depths, SETTINGS), 0
    with caplog.at_level("DEBUG", "pagas_cl"):
        mesh = fuse_within(views, depths, SETTINGS, share * plan.memory_mb)
    assert_same(mesh, fuse(views, depths, SETTINGS))
    assert " boxes, at most " in caplog.text


@pytest.mark.parametrize("settings", [Fusion(voxel=1.0, min_views=2, min_component=0.0),
                                      Fusion(voxel=1.5, truncation=12.0),
                                      Fusion(voxel=1.0, min_component=1.0)])
def test_under_every_rule_of_fusion(scene, settings):
    views, depths = scene
    memory = 0.4 * fusion_plan(views, depths, settings).memory_mb
    assert_same(fuse_within(views, depths, settings, memory), fuse(views, depths, settings))


def test_weights_and_a_far_origin(scene):
    views, depths = scene
    from dataclasses import replace

    moved = []
    for view in views:
        pose = view.camera.world_to_camera.copy()
        pose[:3, 3] -= pose[:3, :3] @ np.array([5e5, -4e6, 300.0])
        moved.append(View(replace(view.camera, world_to_camera=pose), view.image, None, view.name))
    weights = [np.random.default_rng(k).random(depth.shape).astype(np.float32) for k, depth in enumerate(depths)]
    memory = 0.4 * fusion_plan(moved, depths, SETTINGS).memory_mb
    assert_same(fuse_within(moved, depths, SETTINGS, memory, weights=weights), fuse(moved, depths, SETTINGS, weights))


def test_one_grid_where_it_fits(scene, monkeypatch):
    views, depths = scene
    monkeypatch.setattr(blocks, "cut", None)
    mesh, other = fuse_within(views, depths, SETTINGS, 1e5), fuse(views, depths, SETTINGS)
    assert np.array_equal(mesh.vertices, other.vertices) and np.array_equal(mesh.faces, other.faces)


def test_boxes_on_an_executor(scene, tmp_path):
    views, depths = scene
    files = [tmp_path / f"{view.stem}.npz" for view in views]
    for file, depth in zip(files, depths):
        save_depth(file, depth)
    memory = 0.4 * fusion_plan(views, depths, SETTINGS).memory_mb
    reported = []
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        mesh = fuse_within(views, files, SETTINGS, memory, executor=pool, folder=tmp_path,
                           progress=progress_of(lambda *step: reported.append(step)))
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(file.name for file in files)  # nothing is left
    alone = fuse_within(views, depths, SETTINGS, memory)
    assert np.array_equal(mesh.vertices, alone.vertices) and np.array_equal(mesh.faces, alone.faces)
    fused = [step[1:] for step in reported if step[0] == "fuse"]
    assert fused == [(number, len(fused) - 1) for number in range(len(fused))] and len(fused) > 3


def test_every_block_is_in_one_box_and_boxes_fit(scene, tmp_path):
    views, depths = scene
    on_disk, found = plan_with_blocks(views, depths, SETTINGS, BlockFiles(tmp_path))
    allowed = 0.3 * on_disk.memory_mb
    boxes = cut(on_disk, found, allowed, views)
    owners = sum(within(found, box.low, box.high, 0).astype(int) for box in boxes)
    assert (owners == 1).all() and len(boxes) > 3
    assert max(grid_mb(box.blocks, SETTINGS) for box in boxes) < allowed
    plan = fusion_plan(views, depths, SETTINGS)
    assert plan.block_count == on_disk.block_count and plan.memory_mb == on_disk.memory_mb
    assert all(np.array_equal(a, b) for a, b in zip(plan.blocks, on_disk.blocks))


def test_too_little_for_the_mesh_itself_is_refused_before_the_work(scene):
    views, depths = scene
    with pytest.raises(InputError, match=r"fusion is allowed 2 MB, and the mesh.* take \d+ MB: allow \d+ MB"):
        fuse_within(views, depths, SETTINGS, 2.0)


def test_an_empty_mesh_is_said(scene):
    views, depths = scene
    settings = Fusion(voxel=1.0, min_views=4)
    with pytest.raises(InputError, match="fused mesh is empty"):
        fuse_within(views, depths, settings, 0.4 * fusion_plan(views, depths, settings).memory_mb)


@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="the peak of memory is read from Linux's /proc")
def test_a_quarter_of_the_memory_is_enough(tmp_path):
    """Measured: a scene whose grid takes more than four times what is allowed, each in a process of its own."""
    angles = np.radians(np.linspace(-12, 12, 3))
    cameras = [look_at((4 * np.sin(a), 0.2, -4 * np.cos(a)), (0, 0, 0), 576, 432, 504.0, 292.8, 212.5, f"{i}.png")
               for i, a in enumerate(angles)]
    views, depths = rough_views(cameras, rough=0.0003)
    files = [tmp_path / f"{view.stem}.npz" for view in views]
    for file, depth in zip(files, depths):
        save_depth(file, depth)
    (tmp_path / "views.pickle").write_bytes(pickle.dumps((views, files)))
    allowed = fusion_plan(views, files, SETTINGS).memory_mb / 4.2

    def run(*more):
        script = Path(__file__).parents[1] / "support" / "fused_memory.py"
        done = subprocess.run([sys.executable, str(script), str(tmp_path), *more], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    whole, boxes = run(), run(str(allowed))
    assert whole["planned_mb"] > 4 * allowed and whole["peak_mb"] > 2.5 * allowed and allowed > 80
    assert boxes["peak_mb"] <= allowed, boxes
    meshes = []
    for name in ("None", str(allowed)):
        with np.load(tmp_path / f"{name}.npz") as archive:
            from pagas_cl.scene.mesh import Surface

            meshes.append(Surface(archive["vertices"], archive["faces"], archive["normals"], archive["colors"]))
    assert_same(*meshes)
    sys.stdout.write(f"allowed {allowed:.0f} MB: boxes {boxes}, one grid {whole}\n")


@pytest.mark.parametrize("photos, wanted", [("files", True), ("arrays", False)])
def test_a_mesh_run_hands_its_executor_on_to_the_boxes(photos, wanted, tmp_path, monkeypatch):
    """Only where photos and depth maps are files that another process can read."""
    from concurrent.futures import ThreadPoolExecutor

    from PIL import Image

    from pagas_cl.config import Config
    from pagas_cl.jobs.finished import StoredResult
    from pagas_cl.jobs.task import Record
    from pagas_cl.method.surface import blocks
    from pagas_cl.scene.depthmap import save_depth
    from pagas_cl.scene.view import View

    camera = look_at((0, 0, -5), (0, 0, 0), 16, 12, 14.0)
    Image.fromarray(np.zeros((12, 16, 3), np.uint8)).save(tmp_path / "a.png")
    save_depth(tmp_path / "a.npz", np.ones((12, 16), np.float32))
    view = View(camera, tmp_path / "a.png" if photos == "files" else np.zeros((12, 16, 3), np.uint8), None, "a.png")
    given = {}
    monkeypatch.setattr(blocks, "fuse_within", lambda *_, **more: given.update(more))
    with ThreadPoolExecutor(1) as pool:
        fuse_results([view], [StoredResult(camera, tmp_path, Record("a.png", "a", ""))],
                     Config().with_settings(effects__consistency="off", fusion__polish=False),
                     place=Place(None, pool, tmp_path))
        assert (given["executor"] is pool) == wanted and given["folder"] == tmp_path


def test_by_default_little_memory_is_taken_for_the_same_bytes(scene, monkeypatch):
    views, depths = scene
    monkeypatch.setattr(blocks, "USUAL_MB", 0.5 * fusion_plan(views, depths, SETTINGS).memory_mb)
    monkeypatch.setattr(FusionPlan, "mesh_mb", 0.1)
    monkeypatch.setattr(blocks, "fuse", None)        # not in one grid
    mesh, other = fuse_within(views, depths, SETTINGS), fuse(views, depths, SETTINGS)
    for name in ("vertices", "faces", "normals", "colors"):
        assert np.array_equal(getattr(mesh, name), getattr(other, name)), name
