"""Where photos speak for no depth, or for a wrong one, the depth map comes back no worse than it came."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from support.acceptance_scenes import figures, moving, textureless, turned, wrong_poses

from pagas_cl.errors import NothingRefinedWarning
from pagas_cl.method.splat import PhotoStore, ViewInput
from pagas_cl.method.view import acceptance
from pagas_cl.method.view.acceptance import LARGEST, target_photo_reason
from pagas_cl.method.view.one_view import refine_depth
from pagas_cl.refine import refine_views
from pagas_cl.result import KEPT, NO_SURFACE, REFINED, REJECTED

pytestmark = pytest.mark.slow

MISLEADING = {"a plane without texture": textureless, "without texture or noise": lambda: textureless(0.0),
           "wrong poses": wrong_poses, "wrong poses of eight views": lambda: wrong_poses(contexts=8),
           "poses off by a pixel": lambda: wrong_poses(1.0),
           "poses off by 1.2 pixels": lambda: wrong_poses(1.2, contexts=6),
           "poses off by two pixels": lambda: wrong_poses(2.0),
           "moving content": moving, "moving content, coarse depth": lambda: moving(coarse_error=0.5)}
_MOST = 1.02


@pytest.mark.parametrize("name", MISLEADING)
@pytest.mark.parametrize("judged", [False, True], ids=["alone", "with a held-out view"])
def test_no_error_figure_gets_worse(device, name, judged):
    made, (target, *others) = MISLEADING[name]()
    initial = made.initial_depth(made.cameras[0])
    held_out = [others.pop()] if judged else []
    result = refine_depth(target, others, initial, device=device, held_out=held_out)
    before, after = figures(made, initial), figures(made, result.depth)
    assert not {k: (before[k], after[k]) for k in before if after[k] > _MOST * before[k]}


def test_moving_content_costs_only_its_own_part(device):
    made, (target, *others) = moving()
    initial = made.initial_depth(made.cameras[0])
    result = refine_depth(target, others, initial, device=device)
    assert figures(made, result.depth)["mean"] < 0.55 * figures(made, initial)["mean"]
    assert result.counts["rejected"] > 0.1 * initial.size


def test_a_view_that_is_returned_says_why(device):
    made, views = wrong_poses()
    depths = [made.initial_depth(made.cameras[0]), *[None] * (len(views) - 1)]
    with pytest.warns(NothingRefinedWarning):
        result, = refine_views(views, depths, device=device)
    assert result.reason and (result.depth == depths[0]).all() and result.counts["refined"] == 0


def test_a_view_of_one_depth_says_that_a_patch_is_not_seen(device):
    """The other photos see it, and no mask leaves it out: there is nothing around it to compare."""
    made, (target, *others) = wrong_poses(1e-9)
    initial = made.initial_depth(made.cameras[0])
    one = np.zeros_like(initial)
    middle = tuple(size // 2 for size in one.shape)
    one[middle] = initial[middle]
    assert "enough around that" in refine_depth(target, others, one, device=device).reason


def test_good_scenes_keep_their_gain(device):
    made, (target, *others) = wrong_poses(1e-9)
    initial = made.initial_depth(made.cameras[0])
    result = refine_depth(target, others, initial, device=device)
    before, after = figures(made, initial), figures(made, result.depth)
    assert after["mean"] < 0.25 * before["mean"] and after["normal mean"] < 0.6 * before["normal mean"]
    assert result.counts["refined"] > 0.98 * initial.size


def test_what_gets_worse_for_photos_that_took_no_part_goes_back(device):
    """Context photos that all lie off alike pull the depth along; the held-out ones do not."""
    made, (target, *others) = wrong_poses(1e-9, contexts=6)
    wrong = [replace(view, camera=turned(view.camera, 2.0, 0.3)) for view in others[:4]]
    initial = made.initial_depth(made.cameras[0])
    alone = refine_depth(target, wrong, initial, device=device)
    judged = refine_depth(target, wrong, initial, device=device, held_out=others[4:])
    assert judged.reason or judged.counts["rejected"] > alone.counts["rejected"]
    assert figures(made, judged.depth)["mean"] <= figures(made, alone.depth)["mean"]
    assert (judged.depth == initial)[judged.status == REJECTED].all()


def test_photos_that_err_as_the_context_photos_do_hide_no_other(device):
    """Two of the held-out photos lie off as all context photos do, the third one does not."""
    made, (target, *others, right) = wrong_poses(1e-9, contexts=7)
    wrong = [replace(view, camera=turned(view.camera, 1.0, 0.3)) for view in others]
    initial = made.initial_depth(made.cameras[0])
    result = refine_depth(target, wrong[:4], initial, device=device, held_out=[*wrong[4:], right])
    before, after = figures(made, initial), figures(made, result.depth)
    assert after["mean"] < 0.95 * before["mean"]
    assert not {k: (before[k], after[k]) for k in before if after[k] > _MOST * before[k]}


def test_three_photos_that_took_no_part_show_whether_cameras_that_are_off_do_harm(device):
    """With fewer such photos the view comes back for fear of them."""
    made, (target, *others) = wrong_poses(0.8, contexts=7, seed=0)
    initial = made.initial_depth(made.cameras[0])
    alone, judged = (refine_depth(target, others[:4], initial, device=device, held_out=others[4:4 + number])
                     for number in (0, 3))
    assert "are the cameras right" in alone.reason and not judged.reason
    assert figures(made, judged.depth)["mean"] < 0.7 * figures(made, initial)["mean"]
    made, (target, *others) = wrong_poses(1.7, contexts=7, seed=2)
    rejected = refine_depth(target, others[:4], made.initial_depth(made.cameras[0]), device=device, held_out=others[4:])
    assert "took no part" in rejected.reason


def test_photos_that_took_no_part_leave_a_good_result_alone(device):
    made, (target, *others) = wrong_poses(1e-9, contexts=6)
    initial = made.initial_depth(made.cameras[0])
    result = refine_depth(target, others[:4], initial, device=device, held_out=others[4:])
    before, after = figures(made, initial), figures(made, result.depth)
    assert result.report["held_out"] == [view.name for view in others[4:]]
    assert after["mean"] < 0.3 * before["mean"] and result.counts["refined"] > 0.9 * initial.size


@pytest.mark.parametrize("largest", (LARGEST, 5000))
def test_photos_with_poses_of_their_own_judge_where_the_target_is_off_by_more_than_its_depths_moved(
        largest, device, monkeypatch):
    monkeypatch.setattr(acceptance, "LARGEST", largest)      # pixels: above it photos are judged at a smaller size
    made, (target, *others) = wrong_poses(1e-9)
    camera, photos = made.cameras[0], PhotoStore(device)
    right, wrong = made.true_depth(camera), made.initial_depth(camera)
    parallax = np.full_like(right, made.relief.parallax)
    status = np.where(right > 0, REFINED, NO_SURFACE)
    moved = np.sqrt(np.mean((wrong - right)[status == REFINED] ** 2)) / made.relief.parallax

    def reason(before, after, off, contexts=others, held_out=()):
        refined = SimpleNamespace(depth=after, status=status, parallax=parallax)
        given = ViewInput(target, contexts, before, device, photos, held_out)
        return target_photo_reason(refined, given, SimpleNamespace(misaligned=off))

    assert "its own photo" in reason(right, wrong, 2 * moved) and "its own photo" in reason(right, wrong, 0.8 * moved)
    assert not reason(wrong, right, 2 * moved)
    assert not reason(right, wrong, 0.5 * moved, None) and not reason(right, wrong, 2 * moved, [])
    assert not reason(wrong, right, 2 * moved, others[2:], others[:2])
    hardly = (wrong + 1e-3 * (right - wrong)).astype(np.float32)       # better, and not by a hundredth
    assert f"{len(others)} context photos" in reason(wrong, hardly, 2 * moved)
    assert "2 photos that took no part" in reason(wrong, hardly, 2 * moved, others[2:], others[:2])
    away = replace(others[0], camera=replace(others[0].camera, world_to_camera=np.diag([1.0, -1.0, -1.0, 1.0])))
    assert "context photos" in reason(right, wrong, 2 * moved, others, [away])      # that one sees nothing of it


def test_what_is_masked_out_keeps_its_depth_and_is_said(device):
    made, (target, *others) = textureless()
    initial = made.initial_depth(made.cameras[0])
    initial[:2] = 0
    mask = np.ones(initial.shape, bool)
    mask[:, :20] = False
    for masked in (mask, np.zeros_like(mask)):
        result = refine_depth(replace(target, mask=masked), others, initial, device=device)
        out = ~masked & (initial > 0)
        assert (result.status[out] == KEPT).all() and np.array_equal(result.depth[out], initial[out])
        assert np.isinf(result.deviation[out]).all() and not result.confidence[out].any()
        assert (result.status[initial == 0] == NO_SURFACE).all() and not result.depth[initial == 0].any()
