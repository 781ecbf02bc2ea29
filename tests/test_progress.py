"""Progress shows what the device has done, inside a view too, and never runs backwards."""

from __future__ import annotations

import io

import pytest
from support.job_scenes import QUICK, load_small_scene, write_small_scene

pytest.importorskip("pyopencl")
from pagas_cl.errors import InputError
from pagas_cl.method.splat.step import AHEAD, StepProgress
from pagas_cl.method.view.one_view import refine_depth, refine_one
from pagas_cl.progress import LineProgress, Progress, progress_of, reported, shown_on, stage, within_view
from pagas_cl.refine import refine_views

pytestmark = pytest.mark.slow

VIEWS = 8


class Event:
    def __init__(self, waited: list, number: int):
        self.wait = lambda: waited.append(number)


def test_steps_are_reported_when_they_have_ended():
    """Each one after a wait for it, the last AHEAD at the end: the device always has some to go on with."""
    waited, heard = [], []
    steps = StepProgress(lambda done, total: heard.append((done, total, list(waited))), 12)
    for number in range(1, 13):
        steps.enqueued(number, Event(waited, number))
        assert len(waited) == max(0, number - AHEAD)
    steps.finish()
    assert heard == [(k, 12, list(range(1, k + 1))) for k in range(1, 13)]


def test_nobody_listens_and_nothing_waits():
    waited, steps = [], StepProgress(None, 3)
    for number in range(20):
        steps.enqueued(number, Event(waited, number))
    steps.finish()
    assert not waited


def test_a_view_is_not_finished_with_its_steps():
    heard = []
    views = progress_of(lambda *given: heard.append(given)).start("refine", 7)
    within_view(views, 3)(5, 10)
    within_view(views, 3)(10, 10)
    assert heard[0] == ("refine", pytest.approx(3.475), 7) and 3.9 < heard[1][1] < 4


def test_a_view_that_is_tried_again_reports_nothing_new():
    heard = []
    with stage(progress_of(lambda name, done, total: heard.append(done)), "refine", 2) as views:
        for _ in range(2):
            for step in range(1, 5):
                within_view(views, 0)(step, 4)
        views.advance(0)
        views.advance(1)
    assert heard == pytest.approx([0, 0.2375, 0.475, 0.7125, 0.95, 1])


def test_what_progress_may_be():
    class Own:
        def start(self, name, total):
            return self

        def advance(self, done):
            pass

        def finish(self):
            pass

    own = Own()
    assert progress_of(own) is own and isinstance(progress_of(None), Progress)
    assert progress_of(False) is progress_of(None)
    assert isinstance(progress_of(True), Progress) and progress_of(progress_of(print)) is not print
    for wrong in (1, "yes", object()):
        with pytest.raises(InputError, match="progress is a .*, expected True"):
            progress_of(wrong)


def test_lines_where_there_is_no_terminal():
    stream = io.StringIO()
    assert isinstance(shown_on(stream), LineProgress)
    for _ in reported(shown_on(stream), "re\x1b[31mfine", range(3)):
        pass
    with pytest.raises(ZeroDivisionError), stage(shown_on(stream), "fuse", 4) as fusing:
        fusing.advance(1)
        raise ZeroDivisionError
    assert stream.getvalue().splitlines() == ["re\\x1b[31mfine: 3 of 3 in 0 s", "fuse: 1 of 4 in 0 s"]


def test_bars_on_a_terminal():
    """One a stage, gone on with after an error; nothing is drawn between stages, where others write."""
    from rich.console import Console

    from pagas_cl.progress import BarProgress

    console = Console(file=io.StringIO(), force_terminal=True, width=100)
    bars = BarProgress(console)
    with stage(bars, "refine", 2) as views, stage(bars, "pictures", 1):
        views.advance(2)
    with pytest.raises(ZeroDivisionError), stage(bars, "fuse", 4):
        raise ZeroDivisionError
    drawn = console.file.getvalue()
    assert all(name in drawn for name in ("refine", "pictures", "fuse", "2/2", "0/4"))
    assert drawn.count("\x1b[?25l") == drawn.count("\x1b[?25h") == 2      # the cursor is hidden and shown again


def test_a_narrow_terminal_shows_the_figures():
    from rich.console import Console

    from pagas_cl.progress import BarProgress

    console = Console(file=io.StringIO(), force_terminal=True, width=40, color_system=None)
    with stage(BarProgress(console), "solve the mesh", 100) as solving:
        solving.advance(100)
    drawn = console.file.getvalue()
    assert "solve the mesh 100/100 left: 0:00:00" in drawn and "…" not in drawn


def test_steps_of_all_levels(device, made):
    """One count over the pyramid."""
    heard, config = [], QUICK.with_settings(pyramid__scales=(0.5, 1.0), pyramid__steps=(3, 5),
                                             effects__pyramid="set")
    refine_depth(made.views[0], made.views[1:], made.initial_depth(made.views[0].camera), config=config, device=device,
                 progress=lambda *given: heard.append(given))
    assert heard == [(f"refine {made.views[0].name}", pytest.approx(k / 8), 1) for k in range(9)]


@pytest.fixture(scope="module")
def made():
    from support.scenes import relief_scene

    return relief_scene(48, 36, 2, held_out=0)


@pytest.mark.parametrize("kept", [0, 1, 4], ids=["here", "in a folder", "four at a time"])
def test_progress_within_views(tmp_path, device, kept, monkeypatch):
    views, depths = load_small_scene(write_small_scene(tmp_path / "scene"))
    heard = []
    monkeypatch.setattr("pagas_cl.jobs.whole.groups",
                        lambda places, *_: [places[k:k + (kept or 2)] for k in range(0, len(places), kept or 2)])
    refine_views(views, depths, config=QUICK, device=device, folder=tmp_path / "out" if kept else None,
                 progress=lambda *given: heard.append(given))
    done = [given[1] for given in heard]
    assert {(stage, total) for stage, _, total in heard} == {("refine", VIEWS)}
    assert done == sorted(set(done)) and done[0] == 0 and done[-1] == VIEWS
    assert all(any(k < value < k + 1 for value in done) for k in range(VIEWS))      # something within every view


@pytest.mark.parametrize("kept", [False, True], ids=["here", "in a folder"])
def test_what_the_callers_function_raises_comes_back(tmp_path, device, kept):
    """It is not a failure of the view that was under way; views that were finished stay."""
    class Cancelled(Exception):
        pass

    def progress(stage, done, total):
        if 2 < done < 3:
            raise Cancelled("enough")

    views, depths = load_small_scene(write_small_scene(tmp_path / "scene"))
    with pytest.raises(Cancelled, match="enough"):
        refine_views(views, depths, config=QUICK, device=device, folder=tmp_path / "out" if kept else None,
                     progress=progress)
    assert len(list((tmp_path / "out").glob("*.npz"))) == (2 if kept else 0)


def test_work_that_reports_nothing(tmp_path, device):
    """Workers of their own process need not."""
    from concurrent.futures import ThreadPoolExecutor

    from pagas_cl.jobs import refine_all

    views, depths = load_small_scene(write_small_scene(tmp_path / "scene"))
    heard = []
    with ThreadPoolExecutor(1) as executor:
        refine_all(refine_one, views, depths, range(VIEWS), QUICK, executor=executor, folder=tmp_path / "out",
                   progress=progress_of(lambda *given: heard.append(given)))
    assert [given[1] for given in heard] == list(range(VIEWS + 1))
