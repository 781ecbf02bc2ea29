"""A mesh that begins far off is moved by smaller depth maps first, and only then."""

from dataclasses import replace

import numpy as np
import pytest
from support.scenes import relief_scene

from pagas_cl.config import Config
from pagas_cl.method.surface.keep_mesh import Start, kept_mesh
from pagas_cl.method.surface.mesh_evidence import Observed
from pagas_cl.method.surface.mesh_options import MeshOptions
from pagas_cl.method.surface.raster import each_depth
from pagas_cl.result import DepthResult
from pagas_cl.scene.depthmap import REFINED
from pagas_cl.scene.mesh import Surface


@pytest.fixture(scope="module")
def made():
    return relief_scene(160, 120, contexts=4, held_out=0, steps=0)


def results_of(made):
    """The true depth maps, as sure as a tenth of a pixel of parallax."""
    found = []
    for camera in made.cameras[:5]:
        depth = made.true_depth(camera).astype(np.float32)
        every = np.ones(depth.shape, np.float32)
        found.append(DepthResult(camera, depth, np.full(depth.shape, REFINED, np.uint8),
                                 0.1 * made.relief.parallax * every, made.relief.parallax * every))
    return found


def lifted(made, footprints):
    """The true surface, a wave of so many footprints above and below it."""
    vertices, faces = made.initial_mesh(4.0)
    points = vertices.copy()
    points[:, 2] = made.true_solid.height(points[:, 0], points[:, 1])[0]
    span = np.ptp(points[:, 0])
    points[:, 2] += footprints * made.relief.footprint * np.sin(2 * np.pi * points[:, 0] / span)
    return Surface(points, faces)


def sizes_of(mesh, results, device):
    start = Start(results)
    for _ in start.noted(each_depth(mesh, [result.camera for result in results], device)):
        pass
    return start.smaller_sizes()


@pytest.mark.kernels
def test_sizes_follow_how_far_off_the_mesh_begins(made, device):
    results = results_of(made)
    found = [sizes_of(lifted(made, far), results, device) for far in (1.0, 8.0, 30.0)]
    assert found[0] == () and 0 < len(found[1]) < len(found[2])
    assert all(sizes == tuple(sorted(sizes)) and sizes[-1] == 0.5 for sizes in found[1:])


@pytest.mark.kernels
def test_depths_without_a_surface_or_not_refined_say_nothing_of_the_start(made, device):
    results, far = results_of(made), lifted(made, 30.0)
    kept = [replace(result, status=np.zeros_like(result.status)) for result in results]
    assert sizes_of(far, results, device) and sizes_of(far, kept, device) == ()
    assert sizes_of(far, [replace(result, depth=np.zeros_like(result.depth)) for result in results], device) == ()


def test_smaller_maps_are_of_the_same_surface(made):
    result = results_of(made)[0]
    half = Observed.of(result, 0.5)
    assert half.depth.shape == half.deviation.shape == (60, 80) == (half.camera.height, half.camera.width)
    truth = made.true_depth(half.camera)
    off = np.abs(half.depth - truth) / (truth / half.camera.fx)
    assert np.percentile(off, 90) < 0.5
    lost = replace(result, status=np.where(np.arange(160) < 80, REFINED, 0).astype(np.uint8)[None].repeat(120, 0))
    assert np.isinf(Observed.of(lost, 0.25).deviation[:, 21:]).all()
    assert np.isfinite(Observed.of(lost, 0.25).deviation[:, :19]).all()


@pytest.mark.slow
def test_a_mesh_that_begins_far_off_comes_near_by_smaller_sizes(made, device, monkeypatch):
    results = results_of(made)
    views = made.views[:5]

    def error(far):
        mesh = kept_mesh(lifted(made, far), views, results, Config(), MeshOptions("mesh"), device).mesh
        middle = mesh.vertices[mesh.faces].mean(axis=1)
        return np.median(np.abs(middle[:, 2] - made.true_solid.height(middle[:, 0], middle[:, 1])[0]))

    near, far, farther = error(1.0), error(10.0), error(15.0)
    assert far < 2 * near
    monkeypatch.setattr(Start, "smaller_sizes", lambda self: ())
    assert error(15.0) > 10 * farther       # 10 footprints are reached without, by edges that are long at first
