"""Confirmation by other views: exact surfaces, errors in pixels of parallax, occlusion, no parallax."""

import numpy as np
import pytest
from conftest import look_at, plane_depth

from pagas_cl.config import Fusion
from pagas_cl.errors import InputError
from pagas_cl.method.surface import agree

pytestmark = pytest.mark.kernels

NORMAL = np.array([0.3, 0.2, -0.93]) / np.linalg.norm([0.3, 0.2, -0.93])


def confirmations(*given):
    """How many other views confirm each depth."""
    return agree.counts(*given)[0]


def parallax(target, others):
    """One pixel of parallax at the target's middle pixel, by finite differences of the projection."""
    depth = plane_depth(target, NORMAL, 0)
    i, j = target.height // 2, target.width // 2
    ray = target.rays()[i, j] @ target.world_to_camera[:3, :3]
    d, step = depth[i, j], 1e-4
    squared = [np.sum(((c.project(target.center + (d + step) * ray)[0] - c.project(target.center + d * ray)[0])
                       / step) ** 2) for c in others]
    return (i, j), 1 / np.sqrt(np.mean(squared))


def test_every_view_that_sees_a_point_confirms_it(ring):
    depths = [plane_depth(camera, NORMAL, 0) for camera in ring]
    count = confirmations(ring[3], depths[3], ring[:3] + ring[4:], depths[:3] + depths[4:], 0.05)
    assert count.dtype == np.uint16 and count.max() == 6
    points = (ring[3].rays() * depths[3][..., None]) @ ring[3].world_to_camera[:3, :3] + ring[3].center
    seen = np.zeros(count.shape, int)
    for k, camera in enumerate(ring):
        uv, z = camera.project(points)
        seen += (k != 3) & (z > 0) & (uv > 0.5).all(-1) & (uv < (159.5, 119.5)).all(-1)
    assert (count >= seen).all()


@pytest.mark.parametrize("off, confirmed", [(0.5, 6), (1.4, 6), (2.8, 0), (-0.5, 6), (-1.4, 6), (-2.8, 0)])
def test_tolerance_is_in_pixels_of_parallax(ring, off, confirmed):
    others = ring[:3] + ring[4:]
    (i, j), one_pixel = parallax(ring[3], others)
    depth = plane_depth(ring[3], NORMAL, 0)
    depth[i, j] += off * one_pixel
    plane = [plane_depth(camera, NORMAL, 0) for camera in others]  # the point also moves along it: margins
    assert confirmations(ring[3], depth, others, plane, 2.0)[i, j] == confirmed
    assert confirmations(ring[3], depth, others, plane, 4.0)[i, j] == 6


def test_far_errors_are_not_confirmed_and_holes_confirm_nothing(ring):
    depths = [plane_depth(camera, NORMAL, 0) for camera in ring]
    wrong = depths[3] * np.float32(1.2)
    assert confirmations(ring[3], wrong, ring[:3], depths[:3], 2.0).max() == 0
    none = [np.zeros_like(d) for d in depths[:3]]
    assert confirmations(ring[3], depths[3], ring[:3], none, 2.0).max() == 0
    assert confirmations(ring[3], depths[3], ring[:2], [None, None], 2.0).max() == 0
    assert confirmations(ring[3], np.zeros_like(wrong), ring[:3], depths[:3], 2.0).max() == 0


def test_no_parallax_confirms_nothing(ring):
    depth = plane_depth(ring[0], NORMAL, 0)
    assert confirmations(ring[0], depth, [ring[0]], [depth], 2.0).max() == 0


def test_hidden_points_are_not_confirmed_by_what_hides_them(ring):
    depths = [plane_depth(camera, NORMAL, 0) for camera in ring]
    wall = np.full_like(depths[2], 1.0)
    assert confirmations(ring[3], depths[3], [ring[2]], [wall], 2.0).max() == 0


def test_chunks_unit_and_origin(ring, monkeypatch):
    from pagas_cl.scene.camera import Camera

    rng = np.random.default_rng(0)
    depths = [plane_depth(c, NORMAL, 0) * (1 + 0.01 * rng.normal(size=(120, 160))).astype("f4") for c in ring]
    whole = confirmations(ring[3], depths[3], ring[:3], depths[:3], 2.0)
    moved = []
    for c in ring:
        pose = c.world_to_camera.copy()
        pose[:3, 3] = -pose[:3, :3] @ (c.center * 1e3 + 5e6)
        moved.append(Camera(c.width, c.height, c.fx, c.fy, c.cx, c.cy, pose))
    large = [d * np.float32(1e3) for d in depths]
    other = confirmations(moved[3], large[3], moved[:3], large[:3], 2.0)
    assert 0.2 < whole.mean() / 3 < 0.99 and (whole != other).mean() < 1e-3
    monkeypatch.setattr(agree, "_ROWS", 1000)
    assert np.array_equal(confirmations(ring[3], depths[3], ring[:3], depths[:3], 2.0), whole)


def test_depth_maps_without_what_is_not_confirmed(ring):
    depths = [plane_depth(camera, NORMAL, 0) for camera in ring]
    depths[3][40:60, 50:70] *= 1.3
    kept = agree.confirmed(ring, depths, Fusion(agree_views=2))
    assert (kept[3][40:60, 50:70] == 0).all() and (kept[3] > 0).mean() > 0.8
    assert np.array_equal(kept[3][kept[3] > 0], depths[3][kept[3] > 0])
    same = agree.confirmed(ring, depths, Fusion(agree_views=0))
    assert all(a is b for a, b in zip(same, depths))


def test_sizes_must_fit(ring):
    with pytest.raises(InputError, match="its camera says 160 x 120"):
        confirmations(ring[0], np.ones((3, 3)), [], [])
    with pytest.raises(InputError, match="0 depth maps were given for 1 views"):
        confirmations(ring[0], np.ones((120, 160)), ring[:1], [])


def test_look_at_far_views_do_not_count_behind_the_camera():
    front, back = look_at((0, 0, -4), (0, 0, 0)), look_at((0, 0, -4.5), (0, 0, -10))
    depth = plane_depth(front, NORMAL, 0)
    assert confirmations(front, depth, [back], [np.full_like(depth, 4.0)], 2.0).max() == 0


def test_counts_on_a_device_equal_the_twin(ring, device):
    rng = np.random.default_rng(1)
    depths = [plane_depth(c, NORMAL, 0) * (1 + 0.01 * rng.normal(size=(120, 160))).astype("f4") for c in ring]
    for depth in depths:
        depth[rng.uniform(size=depth.shape) < 0.1] = 0
    depths[1][30:60, 20:90] *= 0.8                       # something in front
    others = ring[:3] + ring[4:6], depths[:3] + [None] + depths[5:6]
    want, got = (agree.counts(ring[3], depths[3], *others, 2.0, where) for where in (None, device))
    for name, a, b in zip(("confirmed", "expected"), want, got):
        assert b.dtype == np.uint16 and len(np.unique(a)) > 2, name
        assert (a == b).mean() > 0.999, name
    kept = [agree.confirmed(ring, depths, Fusion(agree_views=2), device=where) for where in (None, device)]
    assert np.mean([(a == b).mean() for a, b in zip(*kept)]) > 0.999


def test_any_number_of_views_on_a_device(device):
    """More cameras than the 64 kB of constant memory hold that every device has; PoCL has room for all the same, so
    that the kernels are read too."""
    from pagas_cl.runtime.program import source

    angles = np.radians(np.linspace(-18, 18, 900))
    cameras = [look_at((4 * np.sin(a), 0.3 * np.cos(5 * a), -4 * np.cos(a)), (0, 0, 0), 12, 10, 11.0, 6, 5)
               for a in angles]
    depths = [plane_depth(camera, NORMAL, 0) for camera in cameras]
    given = cameras[0], depths[0], cameras[1:], depths[1:], 0.5
    want, got = (agree.counts(*given, where)[0] for where in (None, device))
    assert want.max() > 819 and np.abs(got.astype(int) - want).max() <= 2       # a tolerance that float32 may miss
    kernels = source("agree.cl").split("__kernel ")[1:]
    assert len(kernels) == 2 and not any("__constant" in kernel.split("{")[0] for kernel in kernels)
