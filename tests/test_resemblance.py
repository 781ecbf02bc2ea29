"""Context views and judges whose photos do not resemble the target's take no part, and no others."""

from dataclasses import replace

import numpy as np
import pytest
from support.scenes import relief_scene

from pagas_cl.config.presets import BALANCED
from pagas_cl.method.splat import PhotoStore, ViewInput
from pagas_cl.method.view.one_view import refine_one
from pagas_cl.method.view.resemblance import adding, views_to_ask
from pagas_cl.refine import refine_views
from pagas_cl.scene.choice import PartnerChooser

QUICK = BALANCED.with_settings(pyramid__steps=(6,), context__number=4, effects__cameras="off")


def samples(*shares):
    """What photos explain that all see the same 12 x 18 samples."""
    return np.array([np.full((12, 18), share, np.float32) for share in shares])


def test_views_that_resemble_alike_all_take_part_and_wide_ones_first():
    assert adding(samples(0.9, 0.9, 0.9, 0.9), np.array([1.0, 4.0, 2.0, 3.0])) == [1, 3, 2, 0]
    assert adding(samples(0.5, 0.6, 0.5), np.ones(3)) == [1, 0, 2]


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_a_view_that_takes_more_than_it_adds_is_left_out(unit):
    """However large its parallax, which makes it worse; in any unit."""
    for parallax in (1.0, 10.0):
        assert sorted(adding(samples(0.9, 0.85, 0.2, 0.9), unit * np.array([1.0, 1, parallax, 1]))) == [0, 1, 3]


def test_where_few_see_the_surface_all_take_part():
    """Two views of each tile, whatever they are like; a third one has to add to them."""
    explained = samples(0.9, 0.9, 0.2, 0.2, 0.2)
    explained[:2, :, 9:] = np.nan
    explained[2:, :, :9] = np.nan
    assert {0, 1} < set(adding(explained, np.ones(5))) and len(adding(explained[:3], np.ones(3))) == 3
    assert adding(np.full((2, 4, 4), np.nan), np.ones(2)) == []


@pytest.fixture(scope="module")
def made():
    scene = relief_scene(64, 48, 6, held_out=0, spacing=8)
    return scene, [scene.initial_depth(camera) for camera in scene.cameras]


def spoiled(views, which):
    """Their photos show something else."""
    return [replace(view, image=np.roll(view.load_image(), 20, axis=1)) if k in which else view
            for k, view in enumerate(views)]


def informative(views, depths, device, config=QUICK, target=0):
    chosen = PartnerChooser([view.camera for view in views], depths, config.context).choose(target)
    others = [views[k] for k in chosen.all[1:]]
    given = ViewInput(views[target], others, depths[target], device, PhotoStore(device))
    return chosen, *views_to_ask(given, chosen, config)


@pytest.mark.kernels
def test_photos_of_something_else_are_found(made, device):
    scene, depths = made
    chosen, all_of_them, decision = informative(scene.all_views, depths, device)
    assert all_of_them == chosen and not decision.on and decision.evidence == 0 and len(chosen.held_out) == 2
    wrong = {chosen.contexts[1], chosen.held_out[0]}
    views = spoiled(scene.all_views, wrong)
    _, kept, decision = informative(views, depths, device)
    assert set(chosen.all) - set(kept.all) == wrong and decision.on and decision.evidence == pytest.approx(2 / 6)
    assert kept == informative(views, depths, device)[1]
    for config in (QUICK.with_settings(effects__resemblance="off"), QUICK.with_settings(context__number=7)):
        assert informative(views, depths, device, config)[2] is None      # off; fewer are usable than wanted


def test_a_view_is_refined_by_those_that_are_left(made, device):
    scene, depths = made
    chosen = informative(scene.all_views, depths, device)[0]
    views = spoiled(scene.all_views, chosen.contexts[:1])
    alone = refine_one(views, chosen, depths[0], QUICK, device, PhotoStore(device))
    left = replace(chosen, contexts=chosen.contexts[1:])
    wanted = refine_one(views, left, depths[0], QUICK.with_settings(effects__resemblance="off"), device,
                        PhotoStore(device))
    assert alone.depth.tobytes() == wanted.depth.tobytes()
    assert alone.report["contexts"] == [views[k].name for k in left.contexts]
    assert [e["evidence"] for e in alone.report["effects"] if e["effect"] == "resemblance"] == [pytest.approx(1 / 6)]
    agreed = refine_views(views, depths, config=QUICK.with_settings(effects__agreement="on", agreement__steps=0.5),
                          device=device)
    assert views[chosen.contexts[0]].name not in agreed[0].report["contexts"]
    assert len(agreed[0].report["differences"]) == 2


def test_what_was_left_out_stays_so_in_rounds_also_without_names(made, device, monkeypatch):
    from pagas_cl.method.view import rounds

    scene, depths = made
    chosen, used_in_rounds, plain = informative(scene.all_views, depths, device)[0], [], rounds.refine_levels

    def noted(given, *settings, **more):
        used_in_rounds.append((given.target, given.contexts))
        return plain(given, *settings, **more)

    monkeypatch.setattr(rounds, "refine_levels", noted)
    views = [replace(view, name="", camera=replace(view.camera, name=""))
             for view in spoiled(scene.all_views, chosen.contexts[:1])]
    refine_views(views, depths, device=device, config=QUICK.with_settings(
        pyramid__steps=(16,), effects__agreement="on", agreement__steps=0.5, agreement__rounds=2))
    used, = [contexts for target, contexts in used_in_rounds if target is views[0]]
    assert 0 < len(used) < len(chosen.contexts) and not any(view is views[chosen.contexts[0]] for view in used)
