"""What is found of a view while the device is at the one before: the same, and nothing of it where it would be in the
way."""

from dataclasses import replace

import pytest
from support.scenes import relief_scene

from pagas_cl.before_steps import BeforeSteps
from pagas_cl.errors import DeviceError, DeviceLostError, InputError
from pagas_cl.measurements import measure
from pagas_cl.presets import BALANCED
from pagas_cl.refine import refine_views
from pagas_cl.runtime.device import opened
from pagas_cl.splat.budget import plan_for

QUICK = BALANCED.with_settings(pyramid__steps=(8,), context__number=4, effects__cameras="off", effects__agreement="off")
ARRAYS = "depth", "status", "deviation", "parallax"


@pytest.fixture(scope="module")
def made():
    scene = relief_scene(64, 48, 6, held_out=0, spacing=8)
    return scene.all_views, [scene.initial_depth(camera) for camera in scene.cameras]


@pytest.fixture
def with_memory(device):
    """The device as one that has memory of its own, and so a queue beside that of the steps."""
    return opened(replace(device.info, kind="GPU"), device.cl_device, device.lanes)


@pytest.fixture
def known(monkeypatch):
    """Of each view that is refined, whether everything was found before its turn; it is looked at after each step."""
    monkeypatch.setattr("pagas_cl.splat.step.FAR_AHEAD", 1)
    found = []

    class Told(BeforeSteps):
        def finish(self):
            found.append(self.measured is not None)
            super().finish()

    for module in ("refine", "one_view"):
        monkeypatch.setattr(f"pagas_cl.{module}.BeforeSteps", Told)
    return found


def arrays(results):
    return [getattr(result, name).tobytes() for result in results for name in ARRAYS]


@pytest.mark.kernels
def test_found_ahead_is_the_same(made, device, with_memory, known, tmp_path):
    views, depths = made
    wanted = arrays(refine_views(views, depths, config=QUICK, device=device))
    assert known == [False] * 7 or device.info.kind == "GPU"
    for where in ({}, {"folder": tmp_path}):
        known.clear()
        assert arrays(refine_views(views, depths, config=QUICK, device=with_memory, **where)) == wanted
        assert known == [False] + [True] * 6


@pytest.mark.kernels
def test_not_where_memory_is_scarce(made, with_memory, known):
    views, depths = made
    results = refine_views(views, depths, config=QUICK, device=with_memory)
    assert known == [False] + [True] * 6
    known.clear()
    with_memory.memory.limit = int(1.1 * plan_for([view.camera for view in views], 6, QUICK).nbytes)
    assert arrays(refine_views(views, depths, config=QUICK, device=with_memory)) == arrays(results)
    assert known == [False] * 7


def failing(monkeypatch, view, fault, times=float("inf")):
    """Measuring the view called `view` fails so often; the names of all that are measured."""
    asked = []

    def failing(target, *given, **more):
        asked.append(target.name)
        if target.name == view and asked.count(view) <= times:
            raise fault
        return measure(target, *given, **more)

    monkeypatch.setattr("pagas_cl.before_steps.measure", failing)
    return asked


@pytest.mark.kernels
@pytest.mark.parametrize("fault", [InputError("its photo is gone"), DeviceError("too large"), MemoryError("no more")],
                         ids=lambda fault: type(fault).__name__)
def test_a_view_is_none_the_worse_for_the_next_one(made, with_memory, known, tmp_path, monkeypatch, fault):
    """Whatever fails is told of the view that it belongs to; looking ahead fails once and no more."""
    views, depths = made
    wanted = refine_views(views, depths, config=QUICK, device=with_memory)
    asked = failing(monkeypatch, views[3].name, fault)
    results = refine_views(views, depths, config=QUICK, device=with_memory, folder=tmp_path)
    assert [k for k, result in enumerate(results) if "failed" in result.report] == [3]
    assert str(fault) in results[3].report["failed"]
    assert arrays(results[:3] + results[4:]) == arrays(wanted[:3] + wanted[4:])
    assert asked.count(views[3].name) == (2 if isinstance(fault, InputError) else 4)      # ahead, and in its turns


@pytest.mark.kernels
def test_a_device_that_is_lost_ahead_is_opened_again(made, with_memory, known, tmp_path, monkeypatch):
    """The view that it was at is begun anew, and the one that loses it is not looked at ahead any more."""
    views, depths = made
    wanted = refine_views(views, depths, config=QUICK, device=with_memory)
    asked = failing(monkeypatch, views[3].name, DeviceLostError("it answers no more"), times=2)
    results = refine_views(views, depths, config=QUICK, device=with_memory, folder=tmp_path)
    assert arrays(results) == arrays(wanted) and asked.count(views[3].name) == 3


@pytest.mark.kernels
def test_the_view_before_is_told_of_in_memory(made, with_memory, known, monkeypatch):
    (views, depths), told = made, []
    failing(monkeypatch, views[3].name, DeviceError("too large"))
    with pytest.raises(DeviceError, match="too large"):
        refine_views(views, depths, config=QUICK, device=with_memory, on_view=lambda view, *_: told.append(view.name))
    assert told == [view.name for view in views[:3]]
