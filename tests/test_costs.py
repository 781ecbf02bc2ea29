"""The cost model: exact on times that are linear, and on a real run whose work is counted."""

import json
import math
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from support.scenes import relief_scene
from support.synthetic.scene import write_scene

from pagas_cl.__main__ import run as run_command
from pagas_cl.app.tradeoffs import costs
from pagas_cl.config.presets import preset
from pagas_cl.errors import InputError
from pagas_cl.method.cameras.effect import camera_seconds
from pagas_cl.method.splat.exposure import fitted_before
from pagas_cl.refine import refine_views
from pagas_cl.runtime.device import open_device
from pagas_cl.runtime.program import Launch

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def made():
    return relief_scene(96, 72, 4, held_out=0)


def test_linear_times_are_found_again():
    setup, step = costs.setup_and_step(lambda steps: 0.5 + 0.05 * steps)
    assert (setup, step) == pytest.approx((0.5, 0.05))
    pixels, contexts = 1000, 5
    cost = costs.Cost(0.1, setup / pixels / (1 + contexts), step / pixels)
    config = preset("balanced").with_settings(pyramid__steps=(300,))
    assert cost.seconds(config, pixels, contexts) == pytest.approx(0.1 + 0.5 + 300 * 0.05)
    assert cost.seconds(config, pixels, contexts, photos=5) == pytest.approx(0.5 + 0.5 + 300 * 0.05)


def test_colours_are_fitted_as_often_in_a_short_run_as_in_a_long_one():
    """Else their fits would count as steps."""
    assert len(fitted_before(costs._SHORT)) == len(fitted_before(costs._MOST))


def test_levels_count_by_their_share_of_the_pixels():
    cost = costs.Cost(0.0, 0.0, 1.0)
    config = preset("balanced").with_settings(pyramid__scales=(0.5, 1), pyramid__steps=(40, 10))
    assert cost.seconds(config, 1, 3) == pytest.approx(10 + 10)


def test_presets_rise_in_work():
    cost = costs.Cost(0.0, 0.0, 1.0)
    work = [cost.seconds(config, 1, 10) for _, config in costs.preset_ladder()]
    assert all(a < b for a, b in zip(work, work[1:]) if a != b) and work == sorted(work)
    assert {"fast", "balanced", "accurate"} <= {name for name, _ in costs.preset_ladder()}


@pytest.fixture
def work_as_clock(monkeypatch):
    """The model's clock, by work: a work item that is enqueued takes a microsecond, whatever else runs."""
    now = 0.0
    enqueue = Launch.enqueue

    def counted(launch, queue):
        nonlocal now
        now += 1e-6 * math.prod(launch.global_size)
        return enqueue(launch, queue)

    def clock() -> float:
        return now

    monkeypatch.setattr(Launch, "enqueue", counted)
    monkeypatch.setattr(costs, "time", SimpleNamespace(perf_counter=clock))
    return clock


def test_a_run_takes_what_was_expected(made, work_as_clock):
    """By work done, the same on any machine; how far seconds are from it is in the bench."""
    device = open_device(None)
    depths = [made.initial_depth(view.camera) for view in made.views]
    names = [made.views[0].name]
    model = costs.Costs(made.views, depths, device, names=names)

    def expected_and_taken(steps):
        config = preset("balanced").with_settings(pyramid__steps=(steps,), effects__cameras="off")
        expected, start = model.seconds(config), work_as_clock()
        refine_views(made.views, depths, names=names, config=config, device=device)
        return np.array([expected, work_as_clock() - start])

    few, many = expected_and_taken(60), expected_and_taken(200)
    expected, taken = many - few
    assert expected == pytest.approx(taken, rel=0.1)           # what a step costs
    expected, taken = many
    assert 0.85 * taken < expected < 1.01 * taken              # and what comes before and after them


def test_refining_cameras_is_expected_where_they_are_off(made, monkeypatch):
    """A view's share of the scene's, where the effect would be on; measured once."""
    from support.camera_noise import noisy

    device, config = open_device(None), preset("balanced").with_settings(pyramid__steps=(1,))
    depths = [made.initial_depth(view.camera) for view in made.views]
    off = [replace(view, camera=camera) for view, camera in
           zip(made.views, noisy([view.camera for view in made.views], 1.0, 0))]
    assert camera_seconds(made.views, depths, config, device, len(depths)) == 0
    assert camera_seconds(off, depths, config.with_settings(effects__cameras="set"), device, len(depths)) == 0
    assert camera_seconds(off, depths, config, device, 1000) == 0          # not unasked
    expected = costs.Costs(off, depths, device, names=[view.name for view in off[:2]])
    monkeypatch.setattr(costs, "probe", lambda *_, **__: costs.Cost(0.0, 0.0, 0.0))
    with_them = expected.seconds(config)
    assert expected.seconds(config.with_settings(effects__cameras="off")) == 0
    assert with_them == expected.seconds(config) > 0
    assert with_them == pytest.approx(len(off) / 2 * expected._known["cameras", "auto"])


def test_the_richest_setting_that_fits_is_chosen(made, monkeypatch):
    expected = costs.Costs.__new__(costs.Costs)
    expected.pixels, expected.device = [100], open_device(None)
    times = {name: 2.0**k for k, (name, _) in enumerate(costs.preset_ladder())}
    by_config = {config: times[name] for name, config in costs.preset_ladder()}
    monkeypatch.setattr(expected, "seconds", by_config.__getitem__)
    assert expected.choose(times["balanced"])[0] == "balanced"
    assert expected.choose(1e9)[0] == "accurate"
    with pytest.raises(InputError, match="at least 1 s on .* 0.5 s were allowed"):
        expected.choose(0.5)


def test_refine_takes_a_time_instead_of_a_preset(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(costs, "preset_ladder", lambda: [("quick", preset("fast")), ("slow", preset("balanced"))])
    made = relief_scene(64, 48, 2, held_out=0)
    folder = write_scene(made, tmp_path / "scene")
    (folder / "depth_initial" / f"{made.views[2].name}.npz").unlink()          # a view without a depth map
    common = ["refine", str(folder), "--depth-dir", str(folder / "depth_initial"), "--save-depth",
              str(tmp_path / "out"), "--views", made.views[0].name, "--no-align"]
    assert run_command([*common, "--verbose", "--time-per-view", "100", "--set", "pyramid.steps=5", "--report",
                        str(tmp_path / "page")]) == 0
    page = json.loads((tmp_path / "page" / "report.json").read_text())
    assert page["facts"]["settings"] == "slow, pyramid.steps=5"
    assert re.search(r"settings: slow, about \S+ s per view, (?!0\.0 )\S+ minutes", capsys.readouterr().err)
    assert (tmp_path / "out" / f"{made.views[0].name}.npz").is_file()
    for wrong, sentence in ((["--time-per-view", "1", "--time-budget", "1"], "got both"),
                        (["--time-budget", "1", "--preset", "paper"], "leave out --preset paper"),
                        (["--time-per-view", "0"], "expected a number above 0"),
                        (["--time-per-view", "1e-9"], "a view takes at least")):
        assert run_command([*common, *wrong]) == 2
        assert sentence in capsys.readouterr().err
