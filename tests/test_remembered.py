"""What stages took is kept from one run to the next: it comes back, between sizes too, and nothing fails without it."""

from __future__ import annotations

import json

import numpy as np
import pytest

from pagas_cl.outlook import even
from pagas_cl.remembered import Remembered
from pagas_cl.runtime import cache
from pagas_cl.runtime.info import DeviceInfo

HERE = DeviceInfo("a platform", "a device", "CPU")


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(cache, "folder", lambda: tmp_path / "cache")
    return tmp_path / "cache" / "times"


def kept(seconds, work=10.0, stage="refine", info=HERE):
    Remembered(info).keep({stage: (work, even(seconds))})


def total(work=10.0, stage="refine", info=HERE):
    course = Remembered(info).course(stage, work)
    return course and course[-1][1]


def test_another_run_is_told_what_the_first_one_took():
    course = [(0.02, 3.0), (0.5, 3.5), (0.6, 9.0), (1.0, 9.25)]
    Remembered(HERE).keep({"solve": (10.0, course)})
    assert np.allclose(Remembered(HERE).course("solve", 10.0), course)
    assert total() is None
    assert total(stage="solve", info=DeviceInfo("a platform", "another device", "CPU")) is None


def test_it_follows_what_runs_take_now():
    for seconds in (40.0, 20.0, 20.0, 20.0, 20.0):
        kept(seconds)
    assert total() == pytest.approx(20.0, rel=0.07)


def test_a_guess_gives_way_to_what_was_seen_and_that_is_averaged():
    """Of a first run only how long a stage took is known, less what building kernels may have taken: no course."""
    kept(40.0)
    for seconds, expected in ((20.0, 20.0), (10.0, 15.0)):
        Remembered(HERE).keep({"refine": (10.0, [(0.0, 0.0), (0.5, seconds / 4), (1.0, seconds)])})
        assert total() == pytest.approx(expected)


def test_between_two_sizes_and_beyond_them():
    """Small work is dear for its size: that is kept, too."""
    kept(10.0, work=1.0)
    kept(100.0, work=100.0)
    assert total(1.0) == pytest.approx(10.0) and total(100.0) == pytest.approx(100.0)
    assert 10.0 < total(10.0) < 100.0
    assert total(0.1) == pytest.approx(1.0) and total(1000.0) == pytest.approx(1000.0)


def test_sizes_that_were_not_seen_for_long_are_forgotten(folder):
    for power in range(30):
        kept(3.0, work=2.0**power)
    assert len(json.loads(next(folder.iterdir()).read_text())["stages"]["refine"]) < 10
    assert total(2.0**29) == pytest.approx(3.0)


def test_two_runs_at_a_time_lose_nothing_of_each_other():
    one, other = Remembered(HERE), Remembered(HERE)
    one.keep({"refine": (10.0, even(5.0))})
    other.keep({"solve": (10.0, even(7.0))})
    assert total() == pytest.approx(5.0) and total(stage="solve") == pytest.approx(7.0)


def test_other_kernels_are_another_matter(monkeypatch):
    kept(5.0)
    monkeypatch.setattr("pagas_cl.remembered.kernels", lambda: "others")
    assert total() is None


@pytest.mark.parametrize("text", [
    "", "[]", "{", "nonsense", '{"kernels": "KERNELS"}', '{"kernels": "KERNELS", "stages": []}',
    '{"kernels": "KERNELS", "stages": {"refine": 3}}', '{"kernels": "KERNELS", "stages": {"refine": [[1, [2, 3]]]}}',
    '{"kernels": "KERNELS", "stages": {"refine": [[1, ["a", "b"]]]}}', *(
        json.dumps({"kernels": "KERNELS", "stages": {"refine": [[work, [[0.0, 0.0], [end, seconds]]]]}})
        for work, end, seconds in ((0, 1, 1.0), (-1, 1, 1.0), (1, 1, -1.0), (1, 1, float("nan")), (1, 2, 1.0),
                                   (float("inf"), 1, 1.0), (1, 0.5, 1.0)))])
def test_a_file_that_is_broken_is_done_without_and_made_anew(folder, text):
    from pagas_cl.runtime.trial import kernels

    kept(5.0)
    next(folder.iterdir()).write_text(text.replace("KERNELS", kernels()))
    assert total() is None
    kept(6.0)
    assert total() == pytest.approx(6.0)


def test_where_nothing_can_be_written_nothing_is_said(folder, caplog):
    folder.parent.write_text("a file, and no folder")
    with caplog.at_level("INFO", "pagas_cl"):
        kept(5.0)
        assert total() is None
    assert not caplog.records
