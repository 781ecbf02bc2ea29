"""Which surface a pixel next to an edge of depth shows: against the float64 twin, and against the truth."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import plane_depth
from twins import edges as twin

from pagas_cl.config.presets import BALANCED
from pagas_cl.method.splat import PhotoStore, ViewInput, resolve_edges
from pagas_cl.method.surface.agreement import Agreement
from pagas_cl.result import DepthResult
from pagas_cl.runtime.memory import download, upload
from pagas_cl.scene.depthmap import REFINED, REJECTED
from pagas_cl.scene.view import View

pytestmark = pytest.mark.kernels

NORMAL = np.array([0.0, 0.0, -1.0])
IN_FRONT, HALF = 0.4, 0.35            # of the ring's units: a square before a wall
PARALLAX, SURE = 0.05, 0.01


def seen_by(camera, rng):
    """A photo of the square and the wall, and their depth."""
    wall, front = (plane_depth(camera, NORMAL, height).astype(float) for height in (0.0, IN_FRONT))
    at = (camera.rays() * front[..., None] - camera.world_to_camera[:3, 3]) @ camera.world_to_camera[:3, :3]
    depth = np.where((abs(at[..., :2]) < HALF).all(axis=-1) & (front > 0), front, wall)
    world = (camera.rays() * depth[..., None] - camera.world_to_camera[:3, 3]) @ camera.world_to_camera[:3, :3]
    waves = np.sin(world @ rng.normal(size=(3, 3)) * 6)
    color = 120 + 40 * waves + np.where((depth == front)[..., None], (60, -60, 0), (-60, 0, 60))
    return color.clip(0, 255).astype(np.uint8), depth.astype(np.float32)


@pytest.fixture(params=["colour", "grey"])
def scene(ring, request):
    """Views and their results; the middle one's depth has the square two pixels too large, part of that refused."""
    views, depths = [], []
    for number, camera in enumerate(ring):
        photo, depth = seen_by(camera, np.random.default_rng(0))
        if request.param == "grey":
            photo = np.repeat(photo.mean(axis=-1, keepdims=True).astype(np.uint8), 3, axis=-1)
        views.append(View(camera, photo, name=str(number)))
        depths.append(depth)
    results = [DepthResult(camera, depth, np.where(depth > 0, REFINED, 0).astype("u1"), np.full_like(depth, SURE),
                           np.full_like(depth, PARALLAX)) for camera, depth in zip(ring, depths)]
    own, wrong = results[3], depths[3].copy()
    for _ in range(2):
        wrong[1:-1, 1:-1] = np.min([wrong[1:-1, 1:-1], wrong[:-2, 1:-1], wrong[2:, 1:-1], wrong[1:-1, :-2],
                                    wrong[1:-1, 2:]], axis=0)
    is_wrong = wrong < depths[3] - 0.1
    status, deviation = own.status.copy(), own.deviation.copy()
    status[:60][is_wrong[:60]], deviation[:60][is_wrong[:60]] = REJECTED, np.inf
    results[3] = replace(own, depth=wrong, status=status, deviation=deviation)
    return views, results, depths[3], is_wrong


def resolved(views, results, device, own_depth=None):
    """Depth, deviation and status of the middle view, then; `own_depth`: before it was averaged."""
    own, others, target = results[3], results[:3] + results[4:], views[3]
    compared = Agreement(own, others, device)
    known = {name: upload(device, getattr(own, name)) for name in ("depth", "deviation", "status", "parallax")}
    known["own_depth"] = known["depth"] if own_depth is None else upload(device, own_depth)
    resolve_edges(ViewInput(target, views[:3] + views[4:], own.depth, device, PhotoStore(device)), BALANCED, known,
                 compared.count_support)
    compared.release()
    return [download(device, known[name], own.depth.shape, dtype)
            for name, dtype in (("depth", "f4"), ("deviation", "f4"), ("status", "u1"))]


def test_the_device_equals_the_twin(scene, device):
    views, results, _, is_wrong = scene
    own, others, target = results[3], results[:3] + results[4:], views[3]
    moved = (np.arange(own.depth.shape[1]) % 3 == 0) & (own.status == REFINED)
    before = np.where(moved, own.depth - PARALLAX, own.depth)
    found = resolved(views, results, device, before)
    inverses = twin.candidates(*(array.astype(float) for array in (own.depth, before, own.parallax)), own.status)
    some = np.add.outer(*map(np.arange, own.depth.shape)) % 3 == 0     # the twin looks at pixel by pixel
    inverses[:, ~some] = 0
    said = sum(twin.support(inverses, own.parallax.astype(float), target.camera, other.camera,
                            np.where(other.status == REFINED, other.depth, 0)) for other in others)
    number = twin.chosen(inverses, said, target, views[:3] + views[4:])
    taken = np.take_along_axis(inverses, number[None], axis=0)[0]
    want = np.where(number > 0, 1 / np.where(taken > 0, taken, 1), own.depth)
    same = some & (np.abs(found[0] - want) < 1e-5 * want)       # what is nearly equal may fall otherwise
    assert same[some].mean() > 0.999 and same[number > 0].mean() > 0.95 and (number > 0).sum() > 20
    moved = same & (number > 0) & (own.status == REJECTED)
    assert moved.any() and (found[2][moved] == REFINED).all() and (found[1][moved] == np.float32(SURE)).all()
    still = (found[0] == own.depth)
    assert np.array_equal(found[1][still], own.deviation[still]) and np.array_equal(found[2][still], own.status[still])
    again = resolved(views, results, device, before)
    assert all(one.tobytes() == other.tobytes() for one, other in zip(found, again))


def test_pixels_get_the_surface_that_they_show(scene, device):
    """Most of those that had the wrong one; none of the others."""
    views, results, true, is_wrong = scene
    depth, *_ = resolved(views, results, device)
    off = np.abs(depth - true) > 0.1
    grey = np.ptp(views[3].image, axis=-1).max() == 0
    assert is_wrong.sum() > 100 and off[is_wrong].mean() < (0.6 if grey else 0.3) and off[~is_wrong].sum() == 0


def test_nothing_changes_where_there_is_no_edge_or_no_other_map(planes, scene, device):
    views, results, *_ = scene
    depth, *_ = resolved(views, planes, device)
    assert np.array_equal(depth, planes[3].depth)
    unknown = [replace(one, status=np.full_like(one.status, REJECTED)) if k != 3 else one
               for k, one in enumerate(results)]
    depth, *_ = resolved(views, unknown, device)
    assert np.array_equal(depth, results[3].depth)


@pytest.fixture
def planes(ring):
    """What all views say of the wall alone."""
    depths = [plane_depth(camera, NORMAL, 0) for camera in ring]
    return [DepthResult(camera, depth, np.full(depth.shape, REFINED, "u1"), np.full_like(depth, SURE),
                        np.full_like(depth, PARALLAX)) for camera, depth in zip(ring, depths)]
