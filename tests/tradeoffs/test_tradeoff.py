"""Accuracy against time: the figures by hand, and small real studies."""

import io
import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from support.judged_case import judged_case, made_scene
from support.scenes import relief_scene
from support.synthetic.scene import write_scene

import pagas_cl
from pagas_cl.__main__ import run as run_command
from pagas_cl.app.evaluate.depth import compare_depth
from pagas_cl.app.tradeoffs.case import Setting, distinct, fixed, front_plan, make_cases, score
from pagas_cl.app.tradeoffs.costs import view_steps
from pagas_cl.app.tradeoffs.page import _MARKERS, _ticks, closing, headline, markdown, write_report
from pagas_cl.app.tradeoffs.study import Book, Point, Study, measure, pareto
from pagas_cl.config.presets import preset
from pagas_cl.errors import InputError, OutputError
from pagas_cl.jobs import task
from pagas_cl.progress import LineProgress
from pagas_cl.scene.depthmap import central_normals

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True, scope="module")
def one_probe():
    """The device is probed once: every study would, and takes seconds for it."""
    import pagas_cl.app.tradeoffs.case as running

    whole, found = running.probe, []

    def once(*given, **more):
        found[:] = found or [whole(*given, **more)]
        return found[0]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(running, "probe", once)
        yield


@pytest.fixture(scope="module")
def made():
    return made_scene()


@pytest.fixture(scope="module")
def case():
    return judged_case()


def short(name, steps, **settings):
    return Setting(name, fixed("balanced").with_settings(pyramid__steps=(steps,), solver__rate=0.08, **settings),
                   "steps")


def test_front_is_what_no_other_point_beats():
    costs, errors = [1, 2, 2, 3, 4], [5, 4, 3, 3, 1]
    assert pareto(costs, errors).tolist() == [True, False, True, False, True]
    assert pareto([1, 1], [2, 2]).sum() == 1
    assert not pareto([1.0], [np.nan]).any()


def test_plan_has_no_setting_twice():
    settings = front_plan()
    assert len({s.name for s in settings}) == len({s.key for s in settings}) == len(settings)
    groups = {s.group for s in settings}
    assert groups == {"preset", "steps", "context views"} and len(set(_MARKERS)) == len(_MARKERS) >= len(groups)


def test_settings_that_few_views_make_equal_are_measured_once():
    base = preset("balanced")
    settings = [Setting(f"{n}", base.with_settings(context__number=n)) for n in (1, 3, 5, 10)]
    assert [s.name for s in distinct(settings, 4)] == ["1", "3", "5"]


def test_work_counts_levels_by_their_pixels():
    config = preset("balanced").with_settings(pyramid__scales=(0.5, 1), pyramid__steps=(40, 10),
                                              solver__views_per_step=2)
    assert view_steps(config, 10) == pytest.approx(2 * (10 + 10))
    assert view_steps(config, 1) == pytest.approx(10 + 10)
    every = config.with_settings(solver__views_per_step=0)
    assert view_steps(every, 3) == pytest.approx(3 * 20)
    assert view_steps(every.with_settings(context__number=2), 3) == pytest.approx(2 * 20)


def test_held_out_views_take_no_part(case, made):
    assert made.held_out[0].name not in {view.name for view in case.contexts}
    assert [view.name for view in case.held_out] == [made.held_out[0].name]
    assert case.truth is not None and len(case.contexts) == 6


def test_true_normals_are_found_once_for_all_settings(case, monkeypatch):
    case, of_truth = replace(case, held_out=[]), []      # a new one, for which nothing was found yet
    for place in ("tradeoffs.case", "evaluate.depth"):
        def counted(depth, *more):
            of_truth.extend([1] * np.array_equal(depth, case.truth))
            return central_normals(depth, *more)

        monkeypatch.setattr(f"pagas_cl.app.{place}.central_normals", counted)
    scores = [score(case, depth) for depth in (case.initial, 1.01 * case.initial)]
    assert len(of_truth) == 1
    for depth, found in zip((case.initial, 1.01 * case.initial), scores):
        alone = compare_depth(depth, case.truth, case.target.camera, parallax=case.parallax,
                              mask=case.target.load_mask())
        assert (found["depth"], found["normal"]) == (alone.smooth.mean, alone.smooth.normal_mean)
    with pytest.raises(InputError, match="true depth map is 3 x 3, its camera says 96 x 72"):
        score(replace(case, truth=np.ones((3, 3))), case.initial)


def test_case_needs_a_depth(made):
    with pytest.raises(InputError, match="no view can be measured on.*not too small to show, in the cameras' unit"):
        make_cases(made.views, [None] * len(made.views))


def test_arguments_of_another_kind_are_named(made):
    depths = [made.initial_depth(camera) for camera in made.cameras[:len(made.views)]]
    with pytest.raises(InputError, match="views is a str, expected a list of pagas_cl.View"):
        pagas_cl.tradeoff("SCENE", depths)
    with pytest.raises(InputError, match="depth maps were given for"):
        pagas_cl.tradeoff(made.views, depths[1:])
    assert make_cases(made.views, np.stack(depths), truth=np.stack(depths))


def test_a_study_is_written_resumed_and_ranked(case, tmp_path, caplog):
    settings = [short("10 steps", 10), short("40 steps", 40)]
    first = measure([case], settings[:1], report=tmp_path)
    study = measure([case], settings, report=tmp_path)
    data = json.loads((tmp_path / "tradeoff.json").read_text())
    assert len(data["records"]) == 2, "the first setting was not run again"
    assert first.points[0].seconds == next(p.seconds for p in study.points if p.name == "10 steps")
    assert study.figure == "depth" and any(point.on_front for point in study.points)
    by_name = {p.name: p for p in study.points}
    assert by_name["40 steps"].error("depth") < by_name["10 steps"].error("depth") < 1
    assert by_name["40 steps"].view_steps == 40 and by_name["40 steps"].device_bytes > 0
    page = (tmp_path / "index.html").read_text()
    assert "&quot;40 steps&quot; leaves the least, " in page and '>40 steps</td><td data-name="number">2</td>' in page
    assert "<table>" in page and (tmp_path / "tradeoff.png").stat().st_size > 1000
    assert "| **40 steps** |" in markdown(study.points)


def test_a_study_does_not_go_on_from_runs_of_another_version(case, tmp_path, monkeypatch):
    """Whose depth maps, and times, were others."""
    settings = [short("2 steps", 2)]
    first, = measure([case], settings, report=tmp_path).records
    monkeypatch.setattr(task, "RESULTS_FORMAT", task.RESULTS_FORMAT + 1)
    study = measure([case], settings, report=tmp_path)
    assert study.records[0] == first and len(study.records) == 2
    assert study.points[0].seconds == study.records[1]["seconds"]


def test_a_study_of_something_else_is_not_mixed_with_this_one(case, tmp_path):
    """One after the other: other photos or depth under the same name, other views, another device. At once: refused."""
    quick, folder = [short("2 steps", 2)], tmp_path / "report"
    measure([case], quick, report=folder)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert sorted(before) == ["index.html", "tradeoff.json", "tradeoff.png"]
    deeper = replace(case, initial=case.initial * np.float32(1.001))
    darker = replace(case, target=replace(case.target, image=case.target.load_image() // 2))
    judged = replace(case, held_out=case.contexts[-1:])
    around = [replace(view, image=view.load_image() // 2) for view in case.contexts]
    for other, expected in ((deeper, "another photo, camera, depth or truth of"), (darker, "another photo"),
                         (judged, "another photo"), (replace(case, contexts=around), "or of the views around it"),
                         (replace(case, name="z"), f"other views .{case.name}.")):
        with pytest.raises(InputError, match=f"{expected}.*choose another folder"):
            measure([other], quick, report=folder)
    with pytest.raises(InputError, match="is a study on .*, not on another device"):
        Book(folder, "another device", [case])
    stages = []

    def second(stage, done, total):
        with ThreadPoolExecutor(1) as other, pytest.raises(OutputError, match="another run is at work"):
            other.submit(measure, [case], quick, report=folder).result()
        stages.append(stage)

    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    measure([case, replace(case, name="more")], quick, report=folder, progress=second)
    assert stages and len(json.loads((folder / "tradeoff.json").read_text())["records"]) == 2
    assert sorted(path.name for path in folder.iterdir()) == sorted(before)


def test_a_spent_budget_leaves_settings_out_and_says_so(case, caplog):
    lines = io.StringIO()
    study = measure([case], [short("long", 10**6)], budget=0.01, progress=LineProgress(lines))
    assert study.points == [] and study.left_out == ["long"] and lines.getvalue() == "measure: 0 of 1 in 0 s\n"
    with pytest.raises(InputError, match="budget"):
        measure([case], [short("x", 1)], budget=0)


def study_of(**errors):
    """A study of settings with these depth errors, each taking a second longer than the one before."""
    points = [Point(name, "steps", k + 1.0, 10**6, 5, {"depth": error}, 1, k == 0)
              for k, (name, error) in enumerate(errors.items())]
    return Study(points, "depth", {"a.png": {}}, "a <device>", ["last"])


@pytest.mark.parametrize("errors, said", [
    (dict(quick=0.51, slow=0.5), '"slow" leaves the least, 50.0% of the initial depth\'s error, in 2 s a view; "quick" '
                                 'leaves 51.0% in 1 s.'),
    (dict(quick=0.9, slow=0.5), '"slow" leaves the least, 50.0% of the initial depth\'s error, in 2 s a view.'),
    (dict(bad=1.04), 'No setting betters the initial depth: the best, "bad", has 104.0% of the initial depth\'s err'),
    (dict(nothing=float("nan")), "No setting could be judged"), ({}, "Nothing was measured")])
def test_the_headline_of_a_study(errors, said):
    assert headline(study_of(**errors)).startswith(said)


def test_the_page_of_a_study_ends_with_what_was_left_out(tmp_path):
    study = study_of(**{"<b>": 0.5, "other": 0.5})
    page = write_report(tmp_path, study, "d").read_text()
    assert "<b>" not in page and "a &lt;device&gt;" in page
    assert page.index("</table>") < page.index(closing(study)[0]) and "number is that of the point" in page


@pytest.mark.parametrize("low, high", [(0.26, 0.45), (0.9, 1.3), (1e-3, 1e4), (0.15, 30)])
def test_axes_have_a_few_round_numbers(low, high):
    ticks = _ticks(low, high)
    assert 4 <= len(ticks) <= 12 and low <= ticks[0] and ticks[-1] <= high


def test_command_without_truth_judges_by_held_out_photos(tmp_path, capsys, monkeypatch):
    made = relief_scene(80, 60, 6, held_out=1)
    folder = write_scene(made, tmp_path / "scene")
    monkeypatch.setattr("pagas_cl.app.tradeoffs.study.front_plan", lambda: [short("8 steps", 8), short("20 steps", 20)])
    status = run_command(["tradeoff", str(folder), "--depth-dir", str(folder / "depth_initial"), "--views",
                          made.views[0].name, "--report", str(tmp_path / "out"), "--quiet"])
    assert status == 0
    out = capsys.readouterr().out
    assert "no truth here" in out and "20 steps" in out and (tmp_path / "out" / "index.html").is_file()
    assert json.loads((tmp_path / "out" / "tradeoff.json").read_text())["figure"] == "unpredicted"


@pytest.mark.parametrize("number", [2, 5])
def test_without_truth_a_photo_is_spared_to_judge(made, number):
    """Views of a choice that cannot be judged are left out for others; where none can, that is an error."""
    views = made.all_views[:1 + number]
    depths = [made.initial_depth(view.camera) for view in views]
    cases = make_cases(views, depths, sample=2)
    assert len(cases) == 2 and all(case.held_out and case.contexts for case in cases)
    study = measure(cases, [short("4 steps", 4)])
    assert study.figure == "unpredicted" and all(np.isfinite(point.error("unpredicted")) for point in study.points)
    assert headline(study).startswith(('"4 steps" leaves the least', "No setting betters the initial depth"))


def test_what_nobody_can_judge_is_refused(made):
    views = made.all_views[:2]
    depths = [made.initial_depth(view.camera) for view in views]
    with pytest.raises(InputError, match="none has .* a judge"):
        make_cases(views, depths)
    away = np.diag([-1.0, 1, -1, 1]) @ views[1].camera.world_to_camera
    blind = replace(views[1], camera=replace(views[1].camera, world_to_camera=away), name="away")
    with pytest.raises(InputError, match="no view can be judged.*or larger photos of a small thing"):
        measure(make_cases([*views, blind], [*depths, None], held_out=["away"]), [short("4 steps", 4)])


@pytest.mark.parametrize("start, truth", [
    (lambda true: true, lambda true: true),
    (lambda true: np.where(np.arange(true.shape[1]) < 20, true, 0), lambda true: np.where(
        np.arange(true.shape[1]) > 30, true, 0))], ids=["the start itself", "of another part"])
def test_truth_that_no_error_can_be_a_share_of_is_refused(made, start, truth):
    """Before any setting is measured."""
    views = made.all_views[:3]
    true = [made.true_depth(view.camera) for view in views]
    cases = make_cases(views, list(map(start, true)), truth=list(map(truth, true)))
    with pytest.raises(InputError, match="no view can be judged: give truth that lies where its initial depth does"):
        measure(cases, [short("4 steps", 4)])


def test_command_refuses_what_it_cannot_do(tmp_path, capsys):
    folder = write_scene(relief_scene(64, 48, 2, held_out=0), tmp_path / "scene")
    depths = str(folder / "depth_initial")
    assert run_command(["tradeoff", str(folder), "--mesh", "m.ply", "--depth-dir", depths]) == 2
    assert "either --mesh or --depth-dir" in capsys.readouterr().err
    assert run_command(["tradeoff", str(folder), "--depth-dir", depths, "--truth", "nowhere"]) == 2
    assert "nowhere" in capsys.readouterr().err


def test_public_name_is_the_function():
    assert callable(pagas_cl.tradeoff) and pagas_cl.tradeoff.__name__ == "tradeoff"
