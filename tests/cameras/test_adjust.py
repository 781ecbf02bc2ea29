"""Refinement of cameras, its kernels: photos normalised, residuals, derivatives, elimination; against the twins."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import look_at, plane_depth
from twins import adjust as twin
from twins.normalize import normalized

from pagas_cl.method.cameras.adjust import Adjuster, Frame
from pagas_cl.method.cameras.motion import adjoint, moved
from pagas_cl.runtime.memory import download, upload
from pagas_cl.scene.camera import Size

pytestmark = pytest.mark.kernels

NORMAL = np.array([0.2, 0.1, -0.97]) / np.linalg.norm([0.2, 0.1, -0.97])


def photo_of(camera, depth, phase=0.0):
    """A smooth pattern on the plane, as the camera sees it."""
    points = (camera.rays() * depth[..., None]) @ camera.world_to_camera[:3, :3] + camera.center
    x, y = 14 * points[..., 0], 14 * points[..., 1]
    grey = 120 + 50 * np.sin(x + 0.6 * y + phase) * np.cos(1.3 * y) + 40 * np.sin(0.7 * x - 1.9 * y)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)[..., None].repeat(3, -1)


@pytest.fixture(scope="module")
def rig():
    """Four cameras of two sizes over a plane, photos, depth maps that are a little off, one mask."""
    cameras = [look_at((x, y, -4), (0, 0, 0), w, h, 0.9 * w, 0.52 * w, 0.47 * h)
               for x, y, w, h in ((0, 0, 72, 54), (1.1, 0.2, 72, 54), (-0.8, 0.5, 64, 60), (0.2, -1.0, 72, 54))]
    exact = [plane_depth(camera, NORMAL, 0) for camera in cameras]
    photos = [photo_of(camera, depth, 0.01 * k) for k, (camera, depth) in enumerate(zip(cameras, exact))]
    rng = np.random.default_rng(0)
    depths = [(depth * (1 + 0.002 * rng.normal(size=depth.shape))).astype(np.float32) for depth in exact]
    depths[0][20:25, 30:36] = 0
    masks = [None, None, np.ones((60, 64), bool), None]
    masks[2][:, :20] = False
    normals = [normalized(photo, mask, 0.7) for photo, mask in zip(photos, masks)]
    return cameras, depths, photos, masks, normals


def frames(device, rig):
    cameras, depths, _, _, normals = rig
    return [Frame(camera, upload(device, normal.astype(np.float32)), upload(device, depth))
            for camera, depth, normal in zip(cameras, depths, normals)]


def test_normalised_photos_are_the_twin(device, rig):
    from pagas_cl.method.cameras.normalize import normalize_photo
    from pagas_cl.method.splat.photos import rgba

    _, _, photos, masks, normals = rig
    for photo, mask, want in list(zip(photos, masks, normals))[1:3]:
        size = Size(photo.shape[1], photo.shape[0])
        out = device.buffer(4 * size.pixels)
        normalize_photo(device, upload(device, rgba(photo, mask)), size, 0.7, out)
        got = download(device, out, want.shape)
        assert np.array_equal(np.isnan(got), np.isnan(want))
        assert np.nanmax(np.abs(got - want)) < 2e-5


def test_derivatives_are_central_differences(rig):
    """Of the residual by the twists of both cameras, focal lengths, principal points, scale and shift of the depth."""
    cameras, depths, _, _, normals = rig
    target, other, step = cameras[0], cameras[2], 1e-6
    depth = depths[0].astype(np.float64)

    def residual(target=target, other=other, depth=depth):
        return twin.residuals(target, other, depth, depths[2], normals[0], normals[2], 0.02)[0]

    _, gradient, point = twin.residuals(target, other, depth, depths[2], normals[0], normals[2], 0.02)
    by, by_depth = twin.derivatives(target, other, depth, gradient, point)
    relative = adjoint(*other.relative_to(target))
    changes = [*(dict(other=lambda s, k=k: moved(other, s * np.eye(6)[k])) for k in range(6)),
            dict(other=lambda s: replace(other, fx=other.fx * np.exp(s), fy=other.fy * np.exp(s))),
            *({"other": lambda s, n=n: replace(other, **{n: getattr(other, n) + s})} for n in ("cx", "cy")),
            dict(target=lambda s: replace(target, fx=target.fx * np.exp(s), fy=target.fy * np.exp(s))),
            *({"target": lambda s, n=n: replace(target, **{n: getattr(target, n) + s})} for n in ("cx", "cy")),
            dict(depth=lambda s: depth * (1 + s)), dict(depth=lambda s: depth + s),
            *(dict(target=lambda s, k=k: moved(target, s * np.eye(6)[k])) for k in range(6))]
    wanted = [*by.T, *(-by[:, :6] @ relative).T]
    assert np.array_equal(by_depth, by[:, 13])
    for number, (arguments, want) in enumerate(zip(changes, wanted)):
        (name, change), = arguments.items()
        up, down = (residual(**{name: change(sign * step)}) for sign in (1, -1))
        both = np.isfinite(up + down)
        got = (up - down)[both] / (2 * step)
        size = np.abs(want[both]).max()
        near = np.abs(got - want[both]) < 1e-4 * size
        assert both.sum() > 500 and near.mean() > 0.995, (number, near.mean())      # a pixel's border may be crossed


def test_elimination_is_the_full_system(rig):
    """Schur's complement of the system of cameras and depths, and its solution."""
    cameras, depths, _, _, normals = rig
    given = cameras[0], cameras[1:], depths[0], depths[1:], normals[0], normals[1:]
    matrix, right, _, _, steps = twin.block(*given, 1e-3, 0.02)
    n, linearized = 18, []
    for camera, depth, normal in zip(cameras[1:], depths[1:], normals[1:]):
        r, g, point = twin.residuals(cameras[0], camera, depths[0], depth, normals[0], normal, 0.02)
        by, c = twin.derivatives(cameras[0], camera, depths[0], g, point)
        root = np.sqrt(twin.weights(r))
        linearized.append((root[:, None] * by[:, :6], root * c, root * np.nan_to_num(r)))
    seen = np.flatnonzero(np.any([(c != 0) | (by != 0).any(axis=1) for by, c, _ in linearized], axis=0))
    size, rows, sides = len(seen), [], []                 # pixels that no photo sees stay alone
    for k, (by, c, r) in enumerate(linearized):
        full = np.zeros((size, n + size))
        full[:, 6 * k:6 * k + 6] = by[seen]
        full[np.arange(size), n + np.arange(size)] = c[seen]
        rows.append(full)
        sides.append(r[seen])
    A, b = np.concatenate(rows), np.concatenate(sides)
    H, side = A.T @ A, A.T @ b
    H[range(n, n + size), range(n, n + size)] += 1e-3
    want = np.linalg.solve(H + 1e-9 * np.diag(np.r_[np.diag(H)[:n], np.zeros(size)]), -side)[:n]
    M = matrix.reshape(n, n)
    assert np.allclose(M, M.T) and np.linalg.eigvalsh(M)[0] > -1e-9 * np.linalg.eigvalsh(M)[-1]
    got = np.linalg.solve(M + 1e-9 * np.diag(np.diag(H)[:n]), -right.ravel())
    assert got == pytest.approx(want, rel=1e-5, abs=1e-9)
    alone = np.zeros(depths[0].size)
    alone[seen] = -side[n:] / np.diag(H)[n:]
    valid = steps[:, 1] > 0
    assert (steps[:, 0] / np.where(valid, steps[:, 1], 1))[valid] == pytest.approx(alone[valid], abs=1e-12)


@pytest.mark.parametrize("intrinsics", [False, True])
@pytest.mark.parametrize("prior", [1e-3, np.inf])
def test_kernels_are_the_twin(device, rig, intrinsics, prior):
    cameras, depths, _, _, normals = rig
    want = twin.block(cameras[0], cameras[1:], depths[0].astype(np.float64), depths[1:], normals[0], normals[1:], prior,
                      0.02, 14 if intrinsics else 6)
    adjuster = Adjuster(device, 1.0, intrinsics)
    target, *others = frames(device, rig)
    got = adjuster.block(target, others, prior, 0.02)
    assert np.abs(got.used - want[2]).max() <= 2                    # a bound may fall otherwise in float32
    scale = np.sqrt(np.einsum("kiki->ki", want[0]))
    assert np.abs(got.matrix - want[0]).max() < 1e-2 * np.abs(want[0]).max()
    error = (got.matrix - want[0]) / (scale[:, :, None, None] * scale)
    assert np.abs(error).max() < 2e-3
    assert np.abs((got.right - want[1]) / scale).max() < 2e-3 * np.sqrt(want[3].sum())
    assert got.squares == pytest.approx(want[3], rel=2e-3)
    again = adjuster.block(target, others, prior, 0.02)
    assert np.array_equal(got.matrix, again.matrix) and np.array_equal(got.right, again.right)
