"""Time left, by a clock of the test's own: what is to come counts, and what an earlier run did does not."""

from __future__ import annotations

import math

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pagas_cl.outlook import Outlook, even


class Clock:
    """Stands still but for what a stage is said to take."""

    def __init__(self):
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def run(outlook, clock, *work):
    """Do `work`, stages of (name, seconds a unit, first, last): what was left and what was told after each unit."""
    units = [(stage, seconds, k, last) for stage, seconds, first, last in work for k in range(first, last)]
    total, told = sum(seconds for _, seconds, _, _ in units), []
    start = clock.now
    begun = set()
    for stage, seconds, k, last in units:
        if stage not in begun:
            outlook(stage, k if k else 0, last)
            begun.add(stage)
        clock.now += seconds
        outlook(stage, k + 1, last)
        told.append((total - (clock.now - start), outlook.left(), (clock.now - start) / total))
    return told


def assert_true(told, within=0.2):
    for left, said, gone in told:
        assert gone < 0.1 or abs(said - left) <= within * left + 0.05, (gone, left, said)


@pytest.mark.parametrize("speed", [0.02, 1.0, 7.0])
def test_a_machine_of_any_speed(speed):
    """From a tenth on within a fifth of what is left, though nine tenths of the run are other stages."""
    outlook, clock = Outlook(clock := Clock()), clock
    for stage, seconds, kind in (("draw", 1.0, "device"), ("refine", 100.0, "device"), ("agree", 40.0, "device"),
                                 ("pictures", 20.0, "host"), ("fuse", 30.0, "host")):
        outlook.expect(stage, even(seconds), kind)
    host = speed if speed >= 1 else 1.0        # a GPU's machine is no faster than others at what the host does
    assert_true(run(outlook, clock, ("draw", speed, 0, 1), ("refine", 10 * speed, 0, 10), ("agree", 4 * speed, 0, 10),
                    ("pictures", 2 * host, 0, 10), ("fuse", 3 * host, 0, 10)))


def test_what_an_earlier_run_finished_takes_no_time_and_tells_none():
    outlook, clock = Outlook(clock := Clock()), clock
    outlook.expect("refine", even(80.0))
    outlook.expect("fuse", even(20.0))
    outlook.expect_some("refine", 2, 8, 8)
    assert outlook.left() == pytest.approx(40.0)
    outlook("refine", 0, 8)
    for k in range(1, 7):
        outlook("refine", k, 8)         # at once: their files are there
    assert outlook.left() == pytest.approx(40.0)
    assert_true(run(outlook, clock, ("refine", 30.0, 6, 8), ("fuse", 60.0, 0, 1)))


def test_stages_that_are_not_called_for_are_not_waited_for():
    outlook, clock = Outlook(clock := Clock()), clock
    for stage in ("cameras", "refine", "agree", "fuse"):
        outlook.expect(stage, even(50.0))
    run(outlook, clock, ("refine", 25.0, 0, 2))
    assert outlook.left() == pytest.approx(100.0)
    outlook("fuse", 0, 1)
    assert outlook.left() == pytest.approx(50.0)


def test_a_stage_within_another_has_its_own_time():
    """Timing the effects on the first view does not make the others seem slow."""
    outlook, clock = Outlook(clock := Clock()), clock
    outlook("analyze", 0, 10)
    clock.now += 1.0
    outlook("time the effects", 0, 4)
    for k in range(4):
        clock.now += 20.0
        outlook("time the effects", k + 1, 4)
    outlook("analyze", 1, 10)
    assert outlook.left() == pytest.approx(9.0)


def test_nothing_is_known_of_a_stage_that_nobody_expected():
    outlook, clock = Outlook(clock := Clock()), clock
    outlook("make", 0, 4)
    assert outlook.left() == 0.0
    clock.now += 5.0
    outlook("make", 1, 4)
    assert outlook.left() == pytest.approx(15.0)


def test_kernels_that_are_built_in_the_first_step_do_not_count_for_all():
    outlook, clock = Outlook(clock := Clock()), clock
    outlook("refine", 0, 5)
    clock.now += 8.0
    outlook("refine", 0.005, 5)
    assert math.isnan(outlook.left())
    clock.now += 1.0
    outlook("refine", 0.105, 5)
    assert outlook.left() == pytest.approx(48.95)


def go(outlook, clock, stages, speed=1.0):
    """Do `stages`, each (what comes first, seconds of each unit): what was left and what was told after each unit."""
    told = []
    for stage, (first, units) in enumerate(stages):
        outlook(str(stage), 0, len(units))
        clock.now += speed * first
        for done, seconds in enumerate(units, start=1):
            clock.now += speed * seconds
            outlook(str(stage), done, len(units))
            told.append((clock.now, outlook.left()))
    return [(clock.now - now, left) for now, left in told]


def twice(stages, speed=1.0):
    """What was left and what was told in the second of two runs, which knows what the first one took."""
    first, second = Clock(), Clock()
    before, now = Outlook(first), Outlook(second)
    go(before, first, stages)
    for stage, (_, _, course) in before.courses().items():
        now.expect(stage, course, known=True)
    return go(now, second, stages, speed)


def test_a_stage_whose_parts_differ_is_told_as_it_went_before():
    """Seven eighths of the time are in its middle."""
    for left, said in twice([(0.5, [1.0] * 10), (0.0, [1.0] * 8 + [21.0] * 4 + [1.0] * 4)]):
        assert said == pytest.approx(left, rel=0.05, abs=0.1)


@settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(st.tuples(st.floats(0.0, 5.0), st.integers(1, 20), st.floats(0.1, 50.0)), min_size=1, max_size=6),
       st.floats(0.85, 1.2))
def test_a_run_like_the_last_one(stages, speed):
    """Whatever its stages take, and what comes first in each; a machine that is a little faster or slower now."""
    told = twice([(first, [seconds / units] * units) for first, units, seconds in stages], speed)
    total = speed * sum(first + seconds for first, _, seconds in stages)
    for left, said in told:
        assert left > 0.9 * total or abs(said - left) <= 0.2 * left + 0.02 * total


def test_kernels_that_are_built_with_the_first_view_do_not_count_for_the_others():
    """Nor when they take five times as long as they should, in two places of it, or nothing at all."""
    for building in (0.0, 5.0, 25.0):
        outlook, clock = Outlook(clock := Clock()), clock
        outlook.expect("refine", even(20.0, 5.0))
        outlook.expect("solve", even(20.0))
        outlook("refine", 0, 10)
        for done in (0.1, 1.0):
            clock.now += 0.5 * building + 2.0 * done
            outlook("refine", done, 10)
        assert outlook.left() == pytest.approx(38.0, rel=0.1)
        assert_true(run(outlook, clock, ("refine", 2.0, 1, 10), ("solve", 5.0, 0, 4)))


def test_a_short_stage_that_was_guessed_wrong_says_little_of_what_was_seen_here():
    """Of a first run that built kernels it is only guessed what each stage took without them."""
    outlook, clock = Outlook(clock := Clock()), clock
    for stage, seconds in (("cameras", 0.2), ("refine", 14.0), ("solve", 6.0)):
        outlook.expect(stage, even(seconds), known=True)
    assert_true(run(outlook, clock, ("cameras", 1.2, 0, 1), ("refine", 1.4, 0, 10), ("solve", 0.6, 0, 10)))


def test_only_stages_that_came_to_their_end_have_a_course():
    outlook, clock = Outlook(clock := Clock()), clock
    outlook.expect("cameras", even(10.0))
    outlook.expect_some("refine", 5, 10, 10)
    run(outlook, clock, ("refine", 2.0, 5, 10), ("solve", 3.0, 0, 1))
    outlook("fuse", 1, 3)
    courses = outlook.courses()
    assert set(courses) == {"refine", "solve"}
    share, _, course = courses["refine"]
    assert share == 0.5 and course[-1] == pytest.approx((1.0, 10.0)) and course == sorted(course)
