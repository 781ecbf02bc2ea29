"""Memory of the device: planned beforehand, never more than that, and less where there is less, with the same bytes."""

from __future__ import annotations

import gc
import logging
from dataclasses import replace
from functools import lru_cache, partial
from types import SimpleNamespace

import numpy as np
import pyopencl as cl
import pytest
from support.scenes import relief_scene

from pagas_cl.config.presets import BALANCED, FAST, PAPER
from pagas_cl.errors import DeviceError, DeviceMemoryError, InputError
from pagas_cl.method.splat import budget, hypotheses, units
from pagas_cl.method.surface.agree import counts
from pagas_cl.method.view.one_view import refine_depth
from pagas_cl.refine import refine_views
from pagas_cl.runtime import allocations
from pagas_cl.runtime.allocations import Memory, limit_of
from pagas_cl.runtime.arena import BufferSpec, allocate
from pagas_cl.runtime.device import open_device
from pagas_cl.scene.view import View

pytestmark = pytest.mark.slow

INFO = dict(title="a device", max_alloc=2**30, memory=2**32)
CONFIGS = {
    "balanced": BALANCED.with_settings(pyramid__steps=(3,)),
    "fast": FAST.with_settings(pyramid__steps=(3,)),
    "paper": PAPER.with_settings(pyramid__steps=(2, 2)),
    "exposure, pyramid": BALANCED.with_settings(pyramid__scales=(0.3, 0.5, 1.0), pyramid__steps=(2, 2, 2),
                                                effects__exposure="on", loss__unseen_mask=True),
    "alpha, wide, normals": PAPER.with_settings(pyramid__scales=(1.0,), pyramid__steps=(2,), splatting__radius=3.0,
                                                smoothness__kind="normal", smoothness__weight=0.01),
}
ARRAYS = "depth", "status", "deviation", "parallax"


def a_device(**info):
    info = SimpleNamespace(**{**INFO, **info})
    return SimpleNamespace(info=info, buffer=partial(Memory(info.title, info.memory).buffer, None))


@pytest.mark.parametrize("info, shape, kind, sentence", [
    ({}, (2**29,), DeviceError, "'depth' needs 2048 MiB, a device allocates at most 1024 MiB at once"),
    (dict(memory=2**20), (2**20,), DeviceMemoryError, "may hold 1 MB, 0 MB are taken and 4.2 MB more are needed"),
    (dict(max_alloc=2**40, memory=2**40), (289, 12_000_000), DeviceError, r"more than 2\^31 elements"),
])
def test_refused_before_anything_is_allocated(monkeypatch, info, shape, kind, sentence):
    monkeypatch.setattr(allocations, "_Counted", lambda *_: pytest.fail("allocated"))
    with pytest.raises(kind, match=sentence):
        allocate(a_device(**info), [BufferSpec("depth", shape, np.float32)])


def test_an_allocation_that_fails_gives_the_others_back(monkeypatch):
    released = []

    def buffer(counter, context, nbytes, role):
        if nbytes == 12:
            raise cl.MemoryError("clCreateBuffer failed: MEM_OBJECT_ALLOCATION_FAILURE")
        return SimpleNamespace(release=lambda: released.append(nbytes))

    monkeypatch.setattr(allocations, "_Counted", buffer)
    specs = [BufferSpec(str(n), (n,), np.float32) for n in (1, 2, 3)]
    with pytest.raises(DeviceMemoryError, match="refused 0 MB"):
        allocate(a_device(), specs)
    assert released == [4, 8]


@pytest.fixture(autouse=True)
def results_as_they_are(monkeypatch):
    """A view that is refined for a few steps only may well be kept unchanged: here its bytes are compared."""
    monkeypatch.setattr("pagas_cl.method.view.one_view.rejection_reason", lambda *_: "")


@lru_cache
def scene_of(size=(97, 75)):
    """A target, three context views, one larger and one smaller, a held-out view, and a depth near the truth."""
    made = relief_scene(*size, 4)
    target, first, second, third, held_out = made.views
    depth = made.true_depth(target.camera) * (1 + 2e-3 * np.random.default_rng(0).standard_normal(size[::-1]))
    return target, [first, _padded(second, 11), _padded(third, -9)], held_out, depth.astype(np.float32)


def _padded(view, by):
    """The view with `by` more columns, repeated ones, or fewer."""
    camera = replace(view.camera, width=view.camera.width + by)
    image = view.load_image()[:, :camera.width]
    return View(camera, np.pad(image, ((0, 0), (0, camera.width - image.shape[1]), (0, 0)), "edge"), name=view.name)


def refined(device, config, size=(97, 75), held_out=True):
    target, contexts, judge, depth = scene_of(size)
    return refine_depth(target, contexts, depth, config=config, device=device, held_out=[judge] if held_out else [])


def bytes_of(result):
    assert result.counts["refined"] > 10, result.reason
    arrays = tuple(getattr(result, name).tobytes() for name in ARRAYS)
    return arrays, result.report["cost"], result.report["held_out_costs"]


@pytest.fixture
def limited(device):
    """A function that sets how much the device may hold; undone afterwards."""
    gc.collect()
    counter, before, held = device.memory, device.memory.limit, device.memory.held
    counter.held = 0                        # what other tests hold is not counted here
    yield lambda nbytes: setattr(counter, "limit", nbytes)
    gc.collect()
    assert counter.held == 0, "something stays behind"
    counter.limit, counter.held = before, held


@pytest.mark.parametrize("held_out", [True, False])
@pytest.mark.parametrize("name", CONFIGS)
def test_peak_is_as_planned(device, name, held_out):
    gc.collect()
    before = device.memory.held             # of other tests
    report = refined(device, CONFIGS[name], (151, 103), held_out).report
    assert 0.9 < (report["device_bytes"] - before) / report["planned_bytes"] < 1.001
    gc.collect()
    assert device.memory.held == before


def test_the_plan_is_logged_beforehand(device, caplog):
    with caplog.at_level(logging.DEBUG, "pagas_cl"):
        report = refined(device, CONFIGS["balanced"]).report
    assert f"{report['planned_bytes'] / 1e6:,.1f} MB of device memory are planned" in caplog.text


@pytest.mark.parametrize("name", CONFIGS)
def test_less_memory_gives_the_same_bytes(device, limited, caplog, name):
    plenty = refined(device, CONFIGS[name])
    limited(plenty.report["planned_bytes"] - 1)
    with caplog.at_level(logging.WARNING):
        little = refined(device, CONFIGS[name])
    assert "one at a time" in caplog.text
    assert bytes_of(little) == bytes_of(plenty)
    planned = little.report["planned_bytes"]
    assert planned < plenty.report["planned_bytes"]
    assert 0.9 < little.report["device_bytes"] / planned < 1.001


def test_every_allocation_that_can_fail(device, limited, monkeypatch):
    """The driver refuses one buffer, any of them: the same bytes come out, and nothing stays behind."""
    config, calls, plain = CONFIGS["exposure, pyramid"], [0, -1], allocations._Counted

    def counted(*arguments):
        calls[0] += 1
        if calls[0] == calls[1]:
            raise cl.MemoryError("clCreateBuffer failed: MEM_OBJECT_ALLOCATION_FAILURE")
        return plain(*arguments)

    monkeypatch.setattr(allocations, "_Counted", counted)
    wanted, number = bytes_of(refined(device, config, (20, 18))), calls[0]
    assert number > 30
    for k in range(1, number + 1):
        calls[:] = 0, k
        assert bytes_of(refined(device, config, (20, 18))) == wanted


def test_what_was_used_up_when_memory_failed_is_made_anew(device, monkeypatch):
    """The search after the steps fails: by then the depth on the device was given back, and serves others."""
    expected, search, release = refined(device, BALANCED), hypotheses.Hypotheses.search, units.NormalizedDepth.release
    tried = []

    def fails_first(self, *given):
        tried.append(self)
        if len(tried) == 1:
            raise DeviceMemoryError("made up")
        return search(self, *given)

    def overwritten(self):
        cl.enqueue_fill_buffer(device.queue, self.buffer, np.float32(7), 0, self.buffer.nbytes)
        release(self)

    monkeypatch.setattr(hypotheses.Hypotheses, "search", fails_first)
    monkeypatch.setattr(units.NormalizedDepth, "release", overwritten)
    assert bytes_of(refined(device, BALANCED)) == bytes_of(expected) and len(tried) == 2


@pytest.mark.parametrize("name", CONFIGS)
def test_refused_with_a_setting_or_a_size_that_fits(device, limited, name):
    """What is refused before it starts names what fits; that, too, is true."""
    size = 60, 48       # small: what it names makes programs of its own, which then are those of narrow tiles
    target, contexts, judge, depth = scene_of(size)
    cameras = [view.camera for view in (target, *contexts, judge)]
    config = CONFIGS[name]
    for share in (0.9, 0.6, 0.1):
        limited(int(share * budget.plan_for(cameras, 3, config, streamed=True).nbytes))
        with pytest.raises(DeviceMemoryError, match="even with one photo at a time; it fits with"):
            refine_depth(target, contexts, depth, config=config, device=device, held_out=[judge])
        advice = budget.what_fits(cameras, 3, config, device)
        if "--set" in advice:
            pairs = [word.split("=") for word in advice.split() if "=" in word]
            leaner = config.with_settings(**{key.replace(".", "__"): {"true": True}.get(value, value)
                                             for key, value in pairs})
            refined(device, leaner, size)
        else:
            width, height = (int(word) for word in advice.split("photos of ")[1].split(" (")[0].split(" x "))
            small = [camera.resized(width, height) for camera in cameras]
            assert budget.plan_for(small, 3, config, streamed=True).nbytes <= device.memory.limit


def test_views_are_compared_on_the_host_where_the_device_is_too_small(device, limited, caplog):
    target, contexts, _, depth = scene_of()
    others = [view.camera for view in contexts[:1]]
    wanted = counts(target.camera, depth, others, [depth], device=device)
    limited(100)
    found = counts(target.camera, depth, others, [depth], device=device)
    assert "compared on the host" in caplog.text
    assert all((a == b).mean() > 0.999 for a, b in zip(found, wanted))


def test_memory_that_the_environment_allows(monkeypatch):
    monkeypatch.delenv("PAGAS_CL_MEMORY", raising=False)
    assert limit_of(2**30) == 2**30 and limit_of(2**30, 4) == 2**28
    monkeypatch.setenv("PAGAS_CL_MEMORY", "12.5")
    assert limit_of(2**30, 4) == 12_500_000
    for text in ("no", "-1", "0", "nan", "inf"):
        monkeypatch.setenv("PAGAS_CL_MEMORY", text)
        with pytest.raises(InputError, match="PAGAS_CL_MEMORY"):
            limit_of(2**30)


def test_what_is_given_back_waits_for_its_role_and_never_beyond_the_plan():
    device = open_device()
    counter = Memory("a device", 1000)
    counter.begin(600)
    first, other = counter.buffer(device.context, 200, "depth"), counter.buffer(device.context, 200,
                                                                                "depth_per_parallax")
    first.release()
    first.release()                                      # once is enough
    assert (counter.held, counter.waiting, counter.peak) == (200, 200, 400)
    assert counter.buffer(device.context, 200, "depth") is first and counter.waiting == 0
    first.release()
    counter.buffer(device.context, 300, "depth_per_parallax")          # 700 with what waits: more than was planned
    assert counter.waiting == 0
    other.release()
    counter.begin(0)
    assert counter.waiting == 0
    kept = counter.buffer(device.context, 100, "x")
    kept.release()
    counter.clear()
    assert (counter.held, counter.waiting) == (0, 0)     # nobody holds the 300 any more
    assert not counter._kept                             # nor is there anything for sizes that never come again


def test_memory_of_its_own_lets_more_wait():
    device, counter = open_device(), Memory("a device", 1000, spare=0.5)
    counter.begin(200)
    for number in range(3):
        counter.buffer(device.context, 200, f"role {number}").release()
    assert (counter.held, counter.waiting) == (0, 400)   # half of 1000: the one that has waited longest went
    counter.limit = 600
    counter.begin(200)
    assert counter.waiting == 200


def test_a_run_leaves_nothing_waiting():
    made = relief_scene(48, 36, contexts=2)
    device = open_device()
    refine_views(made.views, [made.initial_depth(camera) for camera in made.cameras[:len(made.views)]],
                 config=BALANCED.with_settings(pyramid__steps=(2,)), device=device)
    assert device.memory.waiting == 0


def test_a_buffer_in_whose_making_ctrl_c_was_pressed_is_dropped_without_a_word(monkeypatch):
    said = []
    monkeypatch.setattr("sys.unraisablehook", said.append)
    allocations._Counted.__new__(allocations._Counted)
    gc.collect()
    assert not said
