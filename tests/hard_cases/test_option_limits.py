"""Options of context choice and fusion at their limits: a result that holds, or one sentence that says why not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.scenes import relief_scene

from pagas_cl.config.presets import BALANCED
from pagas_cl.errors import InputError
from pagas_cl.refine import refine_views
from pagas_cl.scene.choice import ContextChooser


def choose_contexts(target, cameras, depths, *settings):
    return ContextChooser(cameras, depths, *settings).choose(target)


pytestmark = pytest.mark.slow

CONTEXT = {
    "context.number = 1": dict(number=1),
    "context.number = 800": dict(number=800),
    "context.min_angle = 0": dict(min_angle=0.0),
    "context.min_angle = 180, max_angle = 180": dict(min_angle=180.0, max_angle=180.0),
    "context.max_angle = min_angle": dict(max_angle=1.0),
    "context.min_angle = 0, max_angle = 0": dict(min_angle=0.0, max_angle=0.0),
    "context.max_angle = 180": dict(max_angle=180.0),
    "context.min_overlap = 0": dict(min_overlap=0.0),
    "context.min_overlap = 1": dict(min_overlap=1.0),
}
NO_CONTEXT = {"context.min_overlap = 1", "context.min_angle = 180, max_angle = 180", "context.max_angle = min_angle",
              "context.min_angle = 0, max_angle = 0"}
FUSION = {
    "fusion.voxel = 0.05": dict(voxel=0.05),
    "fusion.voxel = 1000": dict(voxel=1000.0),
    "fusion.truncation = 1": dict(truncation=1.0),
    "fusion.truncation = 100": dict(truncation=100.0),
    "fusion.min_views = 1000": dict(min_views=1000),
    "fusion.agree_views = 1000": dict(agree_views=1000),
    "fusion.agree_views = 1, agree_pixels = 0": dict(agree_views=1, agree_pixels=0.0),
    "fusion.agree_views = 1, agree_pixels = 1e6": dict(agree_views=1, agree_pixels=1e6),
    "fusion.polish = true": dict(polish=True),
    "fusion.least_weight = 0": dict(least_weight=0.0),
    "fusion.least_weight = 1": dict(least_weight=1.0),
    "fusion.min_component = 0": dict(min_component=0.0),
    "fusion.min_component = 1": dict(min_component=1.0),
}
AGREEMENT = {
    "agreement.rounds = 20": dict(rounds=20, steps=0.0),
    "agreement.steps = 10": dict(rounds=2, steps=10.0),
    "agreement.pixels = 0.001": dict(rounds=1, pixels=1e-3),
    "agreement.pixels = 100": dict(rounds=1, pixels=100.0),
}
PYRAMID = {
    "pyramid.far_off = 0.05, least_side = 1": dict(far_off=(0.05,), least_side=1),
    "pyramid.far_off = 0.99, 0.1, 0.99, least_side = 1": dict(far_off=(0.99, 0.1, 0.99), least_side=1),
    "pyramid.far_off = 0.01, least_side = 1e6": dict(far_off=(0.01,), least_side=10**6),
}
REFUSED = {"fusion.voxel = 1000", "fusion.truncation = 100", "fusion.min_views = 1000", "fusion.agree_views = 1000",
           "fusion.agree_views = 1, agree_pixels = 0"}


@pytest.fixture(scope="module")
def made():
    scene = relief_scene(40, 30, 4)
    return scene.views, [scene.true_depth(view.camera).astype(np.float32) for view in scene.views]


def with_values(stage: str, values: dict):
    return BALANCED.with_settings(pyramid__steps=(3,), **{f"{stage}__{key}": value for key, value in values.items()})


@pytest.mark.filterwarnings("ignore:nothing was refined")
@pytest.mark.parametrize("name", CONTEXT)
def test_context_at_its_limit(device, made, name):
    views, depths = made
    config = with_values("context", CONTEXT[name])
    choice = choose_contexts(0, [view.camera for view in views], depths, config.context)
    assert len(choice.indices) <= config.context.number and 0 not in choice.indices
    assert all(config.context.min_overlap <= overlap <= 1 for overlap in choice.overlaps)
    assert bool(choice.indices) == (name not in NO_CONTEXT)
    first, again = (refine_views(views, depths, names=[views[0].name], config=config,
                                 device=device.info.name)[0] for _ in range(2))
    assert np.isfinite(first.depth).all() and first.depth.tobytes() == again.depth.tobytes()
    if not choice.indices:
        assert choice.reason and first.reason
        assert first.depth.tobytes() == depths[0].tobytes(), "without context views the input stays"


@pytest.mark.parametrize("name", FUSION)
def test_fusion_at_its_limit(device, made, name):
    pytest.importorskip("open3d", reason="fusion takes Open3D")
    from pagas_cl.method.surface.agree import confirmed
    from pagas_cl.method.surface.blocks import fuse_within
    from pagas_cl.method.surface.fuse import weights_of
    from pagas_cl.method.surface.keep_mesh import polished
    from pagas_cl.result import DepthResult

    views, depths = made
    settings = with_values("fusion", FUSION[name]).fusion
    sure = [DepthResult(view.camera, depth, (depth > 0).astype(np.uint8), *[depth * np.float32(1e-3)] * 2)
            for view, depth in zip(views, depths)]
    # A voxel of 1000 footprints is larger than the scene; 500 MB are less than a truncation of 100 voxels takes.
    try:
        surface = fuse_within(views, confirmed([view.camera for view in views], depths, settings), settings, 500.0,
                              weights=weights_of(sure, settings.least_weight))
    except InputError as error:
        assert name in REFUSED, error
        assert "fusion" in str(error) or "depth" in str(error)
        assert "\n" not in str(error)
        return
    assert name not in REFUSED
    if settings.polish:
        surface = polished(surface, sure, BALANCED, device)
    assert np.isfinite(surface.vertices).all() and len(surface.faces)
    assert surface.faces.min() >= 0 and surface.faces.max() < len(surface.vertices)


@pytest.mark.parametrize("name", AGREEMENT)
def test_agreement_at_its_limit(device, made, name):
    views, depths = made
    config = with_values("agreement", AGREEMENT[name]).with_settings(effects__agreement="set", effects__cameras="off")
    first, again = (refine_views(views[:3], depths[:3], config=config, device=device.info.name) for _ in range(2))
    for one, other in zip(first, again):
        assert np.isfinite(one.depth).all() and one.depth.tobytes() == other.depth.tobytes()


@pytest.mark.filterwarnings("ignore:nothing was refined")
@pytest.mark.parametrize("name", PYRAMID)
def test_smaller_sizes_at_their_limit(device, made, name):
    views, depths = made
    config = with_values("pyramid", PYRAMID[name]).with_settings(effects__pyramid="on", effects__cameras="off")
    first, again = (refine_views(views[:3], depths[:3], config=config, device=device.info.name) for _ in range(2))
    for one, other, depth in zip(first, again, depths):
        assert np.isfinite(one.depth).all() and one.depth.tobytes() == other.depth.tobytes()
        assert ((one.depth > 0) == (depth > 0)).all()


def test_every_setting_is_at_a_limit_somewhere():
    """A setting that is added gets a case: here, in support/hard_cases.py, or among those that the other cases vary."""
    from support.hard_cases import CASES

    from pagas_cl.config import setting_names

    in_every_case = {"splatting.blend"} | {name for name in setting_names() if name.startswith("effects.")}
    stages = {"context": CONTEXT, "fusion": FUSION, "agreement": AGREEMENT, "pyramid": PYRAMID}
    there = {f"{stage}.{key}" for stage, cases in stages.items() for values in cases.values() for key in values}
    there |= {key.replace("__", ".") for case in CASES for key in case.settings}
    assert set(setting_names()) - in_every_case <= there


def test_readme_lists_them():
    page = (Path(__file__).parent / "README.md").read_text()
    missing = [name for name in (*CONTEXT, *FUSION, *AGREEMENT, *PYRAMID) if f"| {name} |" not in page]
    assert not missing, missing
