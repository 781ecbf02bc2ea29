"""Every hard case of the table, with each of its blends; the large ones with PAGAS_CL_LARGE=1."""

from __future__ import annotations

import os

import numpy as np
import pytest
from support import hard_cameras
from support import hard_scenes as make
from support.hard_cases import CASES, HARD_SCENES
from support.hard_check import run_case
from support.hard_sizes import SIZES, run_one
from support.hard_table import BLENDS

from pagas_cl.method.splat import PhotoStore, ViewInput, refine_levels
from pagas_cl.method.view.one_view import refine_depth

pytestmark = pytest.mark.slow

RUNS = [pytest.param(case, blend, id=f"{case.name}-{blend}") for case in CASES for blend in case.blends]


@pytest.mark.parametrize("case, blend", RUNS)
def test_case(device, case, blend):
    outcome = run_case(case, blend, device)
    assert outcome.ok, f"worst {outcome.worst:.2g} of {case.tolerance:g}: {'; '.join(outcome.faults)}"


@pytest.mark.parametrize("case", hard_cameras.CASES, ids=lambda case: case.name)
def test_cameras_that_are_off(device, case):
    outcome = hard_cameras.run_camera_case(case, device)
    assert outcome.ok, f"worst {outcome.worst:.2g} of {case.tolerance:g}: {'; '.join(outcome.faults)}"


@pytest.mark.skipif(not os.environ.get("PAGAS_CL_LARGE"), reason="12 and 17 megapixels: PAGAS_CL_LARGE=1, on a GPU")
@pytest.mark.parametrize("blend", BLENDS)
@pytest.mark.parametrize("size", SIZES)
def test_large_case(device, size, blend):
    outcome = run_one(size, blend, device)
    assert outcome.ok, f"worst {outcome.worst:.2g}: {'; '.join(outcome.faults)}"


def test_names_are_unique():
    names = [case.name for case in (*CASES, *hard_cameras.CASES)]
    assert len(set(names)) == len(names)


def test_readme_lists_every_case():
    from pathlib import Path

    page = (Path(__file__).parent / "README.md").read_text()
    named = (*(case.name for case in (*CASES, *hard_cameras.CASES)), *SIZES)
    missing = [name for name in named if f"| {name} |" not in page]
    assert not missing, missing


@pytest.mark.parametrize("blend", BLENDS)
def test_bad_depths_do_not_touch_their_neighbours(device, blend):
    """What is no depth leaves everything around it as if nothing had been there: bit for bit."""
    bad = make.sprinkled([0, -1, np.nan, np.inf, -np.inf, -1e20])
    clean = np.where(np.isfinite(bad.depth) & (bad.depth > 0), bad.depth, 0)
    config = BLENDS[blend].with_settings(pyramid__scales=(1.0,), pyramid__steps=(4,))
    with_bad, without = (refine_levels(ViewInput(bad.target, bad.contexts, depth, device, PhotoStore(device)), config)
                         for depth in (bad.depth, clean))
    for name in ("depth", "status", "deviation", "parallax"):
        assert getattr(with_bad, name)[clean > 0].tobytes() == getattr(without, name)[clean > 0].tobytes()
    assert (with_bad.status[clean == 0] == 0).all()


@pytest.mark.parametrize("case", HARD_SCENES[::2], ids=lambda case: case.name)
def test_default_settings_with_every_effect_on_auto(device, case):
    """refine_depth measures the scene first; that, too, must stand every case."""
    from pagas_cl.errors import InputError

    scene = case.scene()
    try:
        result = refine_depth(scene.target, scene.contexts, scene.depth, device=device.info.name,
                              config=BLENDS["order-free"].with_settings(pyramid__steps=(2,)))
    except InputError as error:
        assert "no valid" in str(error)
        return
    assert np.isfinite(result.depth).all() and not np.isnan(result.deviation).any()
    assert all(not np.isnan(effect["evidence"]) for effect in result.report["effects"]) if result.report else True
