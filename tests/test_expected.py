"""What commands expect of their stages: a first run is told by what machines usually take, the next by what this one
did."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from pagas_cl.expected import Expected
from pagas_cl.outlook import Outlook, until
from pagas_cl.presets import preset
from pagas_cl.runtime import cache
from pagas_cl.runtime.info import DeviceInfo

VIEWS = [SimpleNamespace(camera=SimpleNamespace(width=388, height=290))] * 6
UNITS = {"refine": 60, "agree, round 1": 60, "agree, round 2": 6, "pictures": 6, "render the mesh": 6}


class Machine(Outlook):
    """Hears what is expected of one with one core; takes `work` times as long for it, and `building` times for the
    kernels of a stage, where they are not there."""

    def __init__(self):
        super().__init__(lambda: self.time)
        self.time, self.usual, self.of = 0.0, {}, SimpleNamespace(info=DeviceInfo("", "one core", "CPU"))

    def expect(self, stage, course, *more):
        super().expect(stage, course, *more)
        self.usual[stage] = course

    def run(self, usual, work, building):
        told = []
        for stage, course in usual.items():
            first, units = course[0][1], UNITS.get(stage, 1)
            self(stage, 0, units)
            self.time += building * first
            for unit in range(units):
                self.time += work.get(stage, work[""]) * (until(course, (unit + 1) / units)
                                                          - until(course, unit / units))
                self(stage, unit + 1, units)
                told.append((self.time, self.left()))
        return [(now / self.time, self.time - now, left) for now, left in told]


def expected(machine, name="balanced"):
    made = Expected(machine, VIEWS, preset(name), machine.of)
    made.cameras(True)
    made.mesh_drawn()
    made.rounds(pictures=True)
    made.made(shown=True, solved=True)
    return made


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(cache, "folder", lambda: tmp_path / "cache")
    return tmp_path / "cache"


@pytest.fixture
def usual():
    """Stages of a first run."""
    expected(machine := Machine())
    return machine.usual


def worst(told):
    """Factor by which what was told is off, from a tenth of the run on to nine tenths of it."""
    return max(max((left + 0.5) / (said + 0.5), (said + 0.5) / (left + 0.5))
               for gone, left, said in told if 0.1 <= gone <= 0.9)


@pytest.mark.parametrize("building", [0.0, 1.0, 2.0])
@pytest.mark.parametrize("work", [{"": 1.0}, {"": 1.7}, {"": 0.8, "solve the mesh": 1.3}, {"": 1.0, "refine": 1.4}])
def test_two_runs_on_a_machine(usual, work, building):
    """That its kernels are built, or that they were, is not taken for its pace."""
    made = expected(first := Machine())
    assert worst(first.run(usual, work, building)) < 2.0
    made.remember()
    made = expected(second := Machine())
    assert worst(second.run(usual, work, 0.0)) < (1.25 if building == 1.0 else 1.6)
    made.remember()
    expected(third := Machine())
    assert worst(third.run(usual, work, 0.0)) < 1.25


def test_other_settings_are_told_by_what_is_known_of_these(usual):
    """A machine half as fast as usual: `fast` is told with what `balanced` took there."""
    expected(before := Machine(), "fast")
    made = expected(first := Machine())
    first.run(usual, {"": 2.0}, 2.0)
    made.remember()
    expected(after := Machine(), "fast")
    (_, building), (_, whole) = before.usual["refine"]
    assert until(after.usual["refine"], 1.0) == pytest.approx(2 * (whole - building), rel=0.01)


def test_more_cores_are_faster_and_several_devices_are_not_remembered(folder):
    one, four, several = Machine(), Machine(), Machine()
    four.of = SimpleNamespace(info=DeviceInfo("", "four cores", "CPU", compute_units=4))
    several.of = ["a", "b"]
    for machine in (one, four):
        expected(machine)
    took = [until(machine.usual["refine"], 1.0) - machine.usual["refine"][0][1] for machine in (one, four)]
    assert took[0] == pytest.approx(4 * took[1])
    assert four.usual["pictures"] == one.usual["pictures"]
    made = expected(several)
    several.run(several.usual, {"": 1.0}, 1.0)
    made.remember()
    assert not folder.exists()


def test_who_is_told_nothing_remembers_nothing(folder):
    made = Expected(lambda stage, done, total: None, VIEWS, preset("fast"), Machine().of)
    made.rounds(pictures=False)
    made.remember()
    assert not folder.exists()
