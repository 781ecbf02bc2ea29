"""Settings that only the tables of docs/benchmarks.md measure: stages, made initial depths, the paper's ablation."""

from dataclasses import replace

import numpy as np
import pytest
from bench.front import ablation_table, rank_correlation
from bench.settings import AblationRow, Staged, ablation_plan, every_setting, own_error, random_depth
from support.judged_case import judged_case, made_scene

from pagas_cl.app.tradeoffs.case import Setting, fixed, run, score
from pagas_cl.app.tradeoffs.study import Point
from pagas_cl.method.splat import PhotoStore

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def made():
    return made_scene()


@pytest.fixture(scope="module")
def case():
    return judged_case()


def short(steps, **settings):
    return fixed("balanced").with_settings(pyramid__steps=(steps,), solver__rate=0.08, **settings)


def test_rank_correlation_is_spearmans():
    stats = pytest.importorskip("scipy.stats")
    rng = np.random.default_rng(0)
    a, b = rng.integers(0, 8, 40).astype(float), rng.integers(0, 8, 40).astype(float)
    assert rank_correlation(a, b) == pytest.approx(stats.spearmanr(a, b).statistic)
    assert rank_correlation([1, 2, 3, np.nan], [10, 20, 30, 0]) == pytest.approx(1)
    assert np.isnan(rank_correlation([1, 2], [1, 2]))


@pytest.mark.parametrize("settings", [every_setting(), ablation_plan("paper"), ablation_plan("balanced")])
def test_plans_have_no_setting_twice(settings):
    assert len({s.name for s in settings}) == len({s.key for s in settings}) == len(settings)


def test_tables_have_what_was_requested():
    groups = {s.group for s in every_setting()}
    assert groups == {"preset", "effects", "steps", "views a step", "context views", "model", "levels", "solver",
                      "staged"}
    rows = " ".join(s.name for s in ablation_plan("paper"))
    for row in ("initial depth per view", "random initial depth", "1 context view", "9 context views", "scales 4, 2, 1",
                "steps 200, 100", "steps 100, 200", "rate 1e-4", "radius 3", "4 slices", "no occlusion", "SSIM 0.8",
                "exposure", "view-dependent colour", "stereo consistency"):
        assert row in rows


@pytest.mark.parametrize("made_depth", [own_error, random_depth])
def test_made_initial_depths_are_the_same_every_time(case, made_depth):
    assert np.array_equal(made_depth(case), made_depth(case)) and made_depth(case).dtype == np.float32


def test_made_initial_depths_are_of_the_right_size(case):
    moved = np.abs(own_error(case) - case.initial) / case.parallax
    assert moved[case.parallax > 0].mean() == pytest.approx(0.5, rel=0.2)
    drawn = random_depth(case)
    assert drawn.min() >= case.initial.min() * 0.999 and drawn.max() <= case.initial.max() * 1.001


def test_stages_go_on_from_one_another(case, device):
    photos, config = PhotoStore(device), short(15)
    single, staged = (run(setting, case, device, photos)[0]
                      for setting in (Setting("one", config), Staged("both", config, "staged", (config,))))
    assert staged.view_steps == 2 * single.view_steps
    assert score(case, staged.depth)["depth"] < score(case, single.depth)["depth"]


def test_consistency_leaves_out_what_views_do_not_confirm(case, device, made):
    depths = {case.name: [made.initial_depth(view.camera) for view in case.contexts]}
    agreed = AblationRow("agreed", short(15, fusion__agree_pixels=0.2), agree=1, depths=depths)
    every, kept = (run(row, case, device, PhotoStore(device))[0] for row in (replace(agreed, agree=0), agreed))
    there = kept.depth > 0
    assert 0 < there.sum() < (every.depth > 0).sum()
    assert np.array_equal(kept.depth[there], every.depth[there])


def test_the_table_of_an_ablation_compares_with_its_base():
    points = [Point(name, "ablation", 1.0, 10**6, 5, {"depth": error, "missing": missing}, 1)
              for name, error, missing in (("paper", 0.5, 0.0), ("paper: radius 3", 0.6, 0.1))]
    text = ablation_table(points, {"paper": "0.456", "paper: radius 3": "0.461 (worse)"})
    assert "| radius 3 (90% of the pixels kept) | 0.600 | worse, +20% | 1 | 1 | 0.461 (worse) |" in text
