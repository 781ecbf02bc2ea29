"""Context photos that are relit: on the device against the twin, where it is on, and what it gains."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.scenes import relief_scene
from twins import exposure as exposure_twin
from twins import shading as twin
from twins.photo_loss import Photo
from twins.project import project

from pagas_cl.config.presets import BALANCED
from pagas_cl.method.effects import decide as effects
from pagas_cl.method.splat import PhotoStore, ViewInput, relit_views
from pagas_cl.method.splat.buffers import SampleGrid
from pagas_cl.method.splat.photos import StreamedPhotos
from pagas_cl.method.view.one_view import refine_depth
from pagas_cl.refine import refine_views
from pagas_cl.scene.camera import Size


@pytest.fixture(scope="module")
def made():
    return relief_scene(96, 72, 3, held_out=0, steps=0, detail=0.6)


@pytest.fixture(scope="module")
def shaded(made):
    """Context views whose light comes from another side each: a quarter more or less from edge to edge and back."""
    v, u = np.mgrid[:72, :96] / 72
    return [replace(view, image=np.clip(view.load_image() * (1 + 0.25 * np.sin(4 * (u + k) + 3 * k * v))[..., None],
                                        0, 255).astype(np.uint8)) for k, view in enumerate(made.views[1:], start=1)]


def relit(made, contexts, device, photos):
    given = ViewInput(made.views[0], contexts, made.initial_depth(made.cameras[0]), device, photos)
    return relit_views(given, BALANCED)


@pytest.mark.kernels
def test_equals_the_twin(device, made, shaded):
    found = relit(made, shaded, device, PhotoStore(device))
    target, depth = Photo.from_view(made.views[0]), made.initial_depth(made.cameras[0]).astype(np.float64)
    grid, size = SampleGrid.over(Size(96, 72)), Size(96, 72)
    rows, columns = (np.minimum(np.arange(n) * grid.stride + grid.stride // 2, most - 1)
                     for n, most in ((grid.down, size.height), (grid.across, size.width)))
    at = np.add.outer(rows * size.width, columns).ravel()
    for view, after in zip(shaded, found):
        context = Photo.from_view(view)
        own, other, state = (values.reshape(72 * 96, -1)[at] for values in
                             exposure_twin.match(depth, target, context, None, 0.0, 1.0))
        seen, means = state[:, 0] > 0, project(depth, target.camera, context.camera, 0.0, 1.0).m[at]
        wanted = twin.relit(view.load_image(), means[seen], own[seen], other[seen], SampleGrid.over(size).stride)
        apart = np.abs(after.load_image().astype(int) - wanted)
        assert seen.mean() > 0.5
        assert apart.max() <= 2         # a sample may land on the other side of a cell's border
        assert (apart > 1).mean() < 0.01
        assert np.abs(wanted.astype(int) - view.load_image()).mean() > 3


@pytest.mark.kernels
def test_photos_on_the_host_are_relit_alike(device, made, shaded):
    for one, other in zip(relit(made, shaded, device, PhotoStore(device)),
                          relit(made, shaded, device, StreamedPhotos(device))):
        np.testing.assert_array_equal(one.load_image(), other.load_image())


def refined(made, contexts, device, choice, photos=None):
    return refine_depth(made.views[0], contexts, made.initial_depth(made.cameras[0]), device=device, photos=photos,
                        config=BALANCED.with_settings(effects__shading=choice))


def test_light_that_falls_otherwise_costs_less_depth(device, made, shaded):
    truth, photos = made.true_depth(made.cameras[0]), PhotoStore(device)
    error = {choice: np.median(np.abs(refined(made, shaded, device, choice, photos).depth - truth))
             for choice in ("off", "auto")}
    assert error["auto"] < 0.8 * error["off"]
    assert photos.bytes_of_others([made.views[0], *shaded]) == 0         # relit photos are let go of


@pytest.mark.kernels
def test_photos_that_match_are_not_relit(device, made):
    off, auto = (refined(made, made.views[1:], device, choice) for choice in ("off", "auto"))
    np.testing.assert_array_equal(auto.depth, off.depth)
    assert [effect["on"] for effect in auto.report["effects"] if effect["effect"] == "shading"] == [False]


def test_rounds_of_agreement_relight_by_what_they_start_from(device, made, shaded, monkeypatch):
    depths = [made.initial_depth(camera) for camera in made.cameras]
    views = [made.views[0], *shaded]
    calls = []

    def recorded(given, config):
        calls.append((given.target.name, given.depth))
        return relit_views(given, config)

    monkeypatch.setattr(effects, "relit_views", recorded)
    results = refine_views(views, depths, device=device, config=BALANCED.with_settings(effects__cameras="off"))
    shading = [effect["on"] for result in results for effect in result.report["effects"]
               if effect["effect"] == "shading"]
    first, later = calls[:len(views)], calls[len(views):]
    assert shading == [True] * len(views)
    given = {view.name: depth for view, depth in zip(views, depths)}
    assert all(depth is given[name] for name, depth in first) and sorted(dict(first)) == sorted(given)
    assert sorted(name for name, _ in later) == sorted(given)
    assert not any(np.array_equal(depth, given[name]) for name, depth in later)
