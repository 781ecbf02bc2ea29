"""Depth of a mesh by ray casting: half a pixel, far origins, units, chunks."""

import numpy as np
import pytest
from conftest import look_at, plane_depth

pytest.importorskip("open3d")

from pagas_cl.scene.camera import Camera
from pagas_cl.scene.mesh import Surface, to_surface
from pagas_cl.surface import raster

pytestmark = pytest.mark.slow

NORMAL = np.array([0.3, 0.2, -0.93]) / np.linalg.norm([0.3, 0.2, -0.93])


def render_depths(surface, cameras):
    return list(raster.each_depth(surface, cameras))


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


def test_tilted_plane_at_pixel_centres():
    camera = look_at((0.4, -0.3, -2), (0, 0, 0))
    depth, = render_depths(plane(), [camera])
    truth = plane_depth(camera, NORMAL, 0)
    assert depth.dtype == np.float32 and depth.shape == truth.shape
    assert np.abs(depth / truth - 1).max() < 3e-6
    half_off = np.abs(np.diff(truth, axis=1)).mean() / 2  # what the other convention would be wrong by
    assert np.abs(depth - truth).max() < half_off / 50


@pytest.mark.parametrize("scale, offset", [(1, 5e6), (1e-6, 0), (1e6, 0), (1e3, -3e6)])
def test_origin_and_unit_do_not_matter(scale, offset):
    offset = offset * np.array([1, 0.7, -0.2])
    camera, mesh = look_at((0.4, -0.3, -2), (0, 0, 0)), plane()
    far = Surface(mesh.vertices * scale + offset, mesh.faces)
    depth, = render_depths(mesh, [camera])
    other, = render_depths(far, [moved(camera, scale, offset)])
    assert np.abs(other / scale / depth - 1).max() < 1e-5


def test_no_surface_is_zero_and_chunks_join(monkeypatch):
    camera, mesh = look_at((0, 0, -8), (0, 0, 0)), plane(1.0)
    whole, = render_depths(mesh, [camera])
    assert 0 < (whole > 0).mean() < 1 and (whole >= 0).all()
    monkeypatch.setattr(raster, "_RAYS", 1000)
    assert np.array_equal(render_depths(mesh, [camera])[0], whole)


def test_one_at_a_time(ring):
    each = raster.each_depth(plane(), iter(ring))
    assert next(each).shape == (120, 160) and len(list(each)) == 6


def test_the_nearer_surface_wins():
    mesh = plane()
    both = Surface(np.concatenate([mesh.vertices, mesh.vertices - (0, 0, 1)]),
                   np.concatenate([mesh.faces, mesh.faces + 4]))
    camera = look_at((0.4, -0.3, -4), (0, 0, 0))
    depth, = render_depths(both, [camera])
    assert np.abs(depth / plane_depth(camera, NORMAL, -NORMAL[2]) - 1).max() < 1e-5


def test_real_mesh_against_triangulated_points(data_dir):
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
