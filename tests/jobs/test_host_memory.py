"""What a run holds on the host: no photo that the device has, no other view's depth map, and what it has logged."""

from __future__ import annotations

import pytest
from support.job_scenes import QUICK, load_small_scene, write_small_scene

pytest.importorskip("pyopencl")
from pagas_cl.jobs import worker
from pagas_cl.method.splat import PhotoStore
from pagas_cl.method.view import rounds
from pagas_cl.refine import refine_views
from pagas_cl.result import DepthResult

pytestmark = pytest.mark.slow


@pytest.fixture
def workers(monkeypatch):
    """Every worker that is made here."""
    made, make = [], worker.Worker.__init__
    monkeypatch.setattr(worker.Worker, "__init__", lambda self, *given: (make(self, *given), made.append(self))[0])
    return made


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return load_small_scene(write_small_scene(tmp_path_factory.mktemp("memory") / "scene"))


def test_a_photo_is_here_or_on_the_device(scene, tmp_path, device, workers):
    views, depths = scene
    twice, looked = [], []

    def look(stage, done, total):
        for context in workers:
            looked.append(stage)
            twice.extend(view.name for view in context.photos._ahead.keys() & context.photos._held.keys())

    refine_views(views, depths, config=QUICK, device=device, folder=tmp_path, progress=look)
    assert looked and not twice


def test_depth_maps_of_the_round_before_are_let_go_of(scene, tmp_path, device, workers):
    """On a CPU none is kept; on others none of the host, in a folder."""
    views, depths = scene
    config = QUICK.with_settings(agreement__rounds=2, agreement__steps=0.5, effects__agreement="on")
    held = []

    def look(stage, done, total):
        for context in workers:
            held.extend(owner for owner in context.photos._held if isinstance(owner, DepthResult)
                        or context.photos.on_host and isinstance(owner, tuple) and done == int(done))

    stored = refine_views(views, depths, config=config, device=device, folder=tmp_path, progress=look)
    here = refine_views(views, depths, config=config, device=device)
    assert not held
    assert all((a.depth == b.depth).all() for a, b in zip(stored, here))


def test_a_device_with_memory_of_its_own_has_the_results_of_the_round_before(scene, tmp_path, device, monkeypatch):
    views, depths = scene
    config = QUICK.with_settings(agreement__rounds=2, agreement__steps=0.5, effects__agreement="on")
    wanted, sent = refine_views(views, depths, config=config, device=device), []
    make, send = PhotoStore.__init__, rounds.send

    def on_its_own(self, *given):
        make(self, *given)
        self.on_host = False

    monkeypatch.setattr(PhotoStore, "__init__", on_its_own)
    monkeypatch.setattr(rounds, "send", lambda *given: sent.append(given) or send(*given))
    found = refine_views(views, depths, config=config, device=device, folder=tmp_path)
    assert len(sent) == sum(not result.reason for result in found)     # before the first round; it leaves them there
    assert all((a.depth == b.depth).all() for a, b in zip(found, wanted))
