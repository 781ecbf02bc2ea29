"""Depth of a mesh, drawn on a device and by ray casting: half a pixel, far origins, units, hard triangles, parts."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import look_at, plane_depth
from support.scenes import relief_scene
from twins import raster as raster_twin

from pagas_cl.method.surface import raster
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.mesh import Surface
from pagas_cl.scene.meshes.kinds import to_surface

pytestmark = pytest.mark.kernels

NORMAL = np.array([0.3, 0.2, -0.93]) / np.linalg.norm([0.3, 0.2, -0.93])


@pytest.fixture(params=["device", "open3d"])
def render_depths(request):
    """each_depth, drawn or cast, as a list."""
    if request.param == "open3d":
        pytest.importorskip("open3d")
    where = request.getfixturevalue("device") if request.param == "device" else None
    return lambda surface, cameras: list(raster.each_depth(surface, cameras, where))


def random_mesh(rng, number=60):
    """Triangles of all sizes around the cameras of `around`: slivers, some behind, some through the camera's plane."""
    middles, size = rng.normal(size=(number, 1, 3)) * 2, 10 ** rng.uniform(-2, 1, (number, 1, 1))
    corners = middles + size * rng.normal(size=(number, 3, 3))
    corners[::5, 2] = corners[::5, 0] + 0.6 * (corners[::5, 1] - corners[::5, 0]) + 1e-4       # slivers
    corners[1] = corners[1, 0]                                                          # a point
    corners[2] = 40 * np.array([[-1, -1, 0.1], [1, -1, 0.1], [0, 2, 0.15]])              # larger than the picture
    return Surface(corners.reshape(-1, 3), np.arange(3 * number).reshape(-1, 3))


def plane(size=10.0):
    """A large tilted square through the origin."""
    u = np.cross(NORMAL, (0, 1, 0))
    u /= np.linalg.norm(u)
    v = np.cross(NORMAL, u)
    corners = size * np.array([u + v, u - v, -u - v, -u + v])
    return Surface(corners, [[0, 1, 2], [0, 2, 3]])


def moved(camera, scale=1.0, offset=(0, 0, 0)):
    pose = camera.world_to_camera.copy()
    pose[:3, 3] = -pose[:3, :3] @ (scale * camera.center + offset)
    return Camera(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, pose, camera.name)


def test_tilted_plane_at_pixel_centres(render_depths):
    camera = look_at((0.4, -0.3, -2), (0, 0, 0))
    depth, = render_depths(plane(), [camera])
    truth = plane_depth(camera, NORMAL, 0)
    assert depth.dtype == np.float32 and depth.shape == truth.shape
    assert np.abs(depth / truth - 1).max() < 3e-6
    half_off = np.abs(np.diff(truth, axis=1)).mean() / 2  # what the other convention would be wrong by
    assert np.abs(depth - truth).max() < half_off / 50


@pytest.mark.parametrize("scale, offset", [(1, 5e6), (1e-6, 0), (1e6, 0), (1e3, -3e6)])
def test_origin_and_unit_do_not_matter(scale, offset, render_depths):
    offset = offset * np.array([1, 0.7, -0.2])
    camera, mesh = look_at((0.4, -0.3, -2), (0, 0, 0)), plane()
    far = Surface(mesh.vertices * scale + offset, mesh.faces)
    depth, = render_depths(mesh, [camera])
    other, = render_depths(far, [moved(camera, scale, offset)])
    assert np.abs(other / scale / depth - 1).max() < 1e-5


def test_no_surface_is_zero_and_chunks_join(monkeypatch, render_depths):
    camera, mesh = look_at((0, 0, -8), (0, 0, 0)), plane(1.0)
    whole, = render_depths(mesh, [camera])
    assert 0 < (whole > 0).mean() < 1 and (whole >= 0).all()
    monkeypatch.setattr(raster, "_RAYS", 1000)
    monkeypatch.setattr(raster, "_PART", 1)
    assert np.array_equal(render_depths(mesh, [camera])[0], whole)


def test_one_at_a_time(ring, device):
    each = raster.each_depth(plane(), iter(ring), device)
    assert next(each).shape == (120, 160) and len(list(each)) == 6


def test_the_nearer_surface_wins(render_depths):
    mesh = plane()
    both = Surface(np.concatenate([mesh.vertices, mesh.vertices - (0, 0, 1)]),
                   np.concatenate([mesh.faces, mesh.faces + 4]))
    camera = look_at((0.4, -0.3, -4), (0, 0, 0))
    depth, = render_depths(both, [camera])
    assert np.abs(depth / plane_depth(camera, NORMAL, -NORMAL[2]) - 1).max() < 1e-5


def test_drawn_depth_is_that_of_the_twin_for_all_kinds_of_triangles(device):
    camera = look_at((0.3, -0.2, -2.5), (0, 0, 0), 96, 72, 70.0, 47.3, 36.9)
    for seed in range(3):
        mesh = random_mesh(np.random.default_rng(seed))
        drawn, again = (next(raster.each_depth(mesh, [camera], device)) for _ in range(2))
        assert np.array_equal(drawn, again)
        want, *moved = (raster_twin.depth_of(mesh, replace(camera, cx=camera.cx + by)) for by in (0, -1e-3, 1e-3))
        low, high = np.minimum(*moved), np.maximum(*moved)
        inside = high - low <= 0.01 * want      # a centre on an edge, to a thousandth of a pixel, may fall either way
        assert inside.mean() > 0.95
        with np.errstate(invalid="ignore"):
            apart = np.abs(drawn / want - 1)[inside & (want > 0)]
        assert apart.max() < 1e-6 and ((drawn > 0) == (want > 0))[inside].all()


def test_drawn_depth_is_that_of_ray_casting(device):
    pytest.importorskip("open3d")
    made = relief_scene(160, 120, contexts=4, held_out=0, bar=6.0)
    mesh, cameras = Surface(*made.initial_mesh(1.0)), made.cameras[:3]
    for drawn, cast in zip(raster.each_depth(mesh, cameras, device), raster.each_depth(mesh, cameras)):
        assert np.array_equal(drawn > 0, cast > 0)
        with np.errstate(invalid="ignore"):
            apart = np.abs(drawn / cast - 1)[cast > 0]
        assert (apart > 1e-6).sum() <= 1          # a centre on an edge of the bar


def test_no_pixel_falls_between_triangles(device):
    """A fan whose edges and corners pass through pixel centres."""
    camera = look_at((0, 0, -8), (0, 0, 0), 64, 64, 64.0, 32.0, 32.0)
    angles = np.linspace(0, 2 * np.pi, 17)[:-1]
    rim = np.stack([6 * np.cos(angles), 6 * np.sin(angles), 0 * angles], axis=1)
    step = 8 / 64
    fan = Surface(np.vstack([[0.5 * step, 0.5 * step / 1.01, 0], rim]),
                  [[0, 1 + k, 1 + (k + 1) % 16] for k in range(16)])
    drawn = next(raster.each_depth(fan, [camera], device))
    assert np.abs(drawn - 8).max() < 1e-5


def test_a_mesh_larger_than_its_share_of_memory_is_drawn_in_parts(device, monkeypatch):
    made = relief_scene(96, 72, contexts=3, held_out=1)
    mesh, cameras = Surface(*made.initial_mesh(2.0)), made.cameras[:2]
    whole = list(raster.each_depth(mesh, cameras, device))
    monkeypatch.setattr(device.memory, "limit", device.memory.held + 400_000)
    monkeypatch.setattr(raster, "_PART", 500)
    assert raster.Drawing(device, mesh)._held is None
    for a, b in zip(whole, raster.each_depth(mesh, cameras, device)):
        assert np.array_equal(a, b)


@pytest.mark.slow
def test_real_mesh_against_triangulated_points(data_dir, render_depths):
    from pagas_cl.scene.readers import read_scene

    o3d = pytest.importorskip("open3d")
    folder = data_dir / "dtu_scan24"
    camera = read_scene(folder).views[7].camera.resized(400, 300)
    depth, = render_depths(to_surface(folder / "derived" / "mesh_coarse.ply"), [camera])
    points = np.asarray(o3d.io.read_point_cloud(str(folder / "derived" / "sparse_points_mm.ply")).points)
    uv, z = camera.project(points)
    inside = (z > 0) & (uv > 1).all(1) & (uv < (399, 299)).all(1)
    at = uv[inside].astype(int)
    rendered = depth[at[:, 1], at[:, 0]]
    seen = rendered > 0
    assert seen.mean() > 0.6
    assert np.median(np.abs(rendered[seen] - z[inside][seen])) < 1.5  # mm; the points are good to half of one
