"""Cameras that are far off are brought back or refused, with good depth and with depth as networks leave it."""

import numpy as np
import pytest
from bench.cameras_far import far, summary
from support.scenes import relief_scene

from pagas_cl.method.cameras.accept import too_far
from pagas_cl.method.cameras.motion import exponential, initial_rotations, rotated
from pagas_cl.scene.view import View

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("depth, pixels, seed", [("good", 0.5, 3), ("good", 14.0, 0), ("network", 10.0, 1),
                                                 ("network", 30.0, 0)])
def test_what_is_accepted_is_right(device, depth, pixels, seed):
    row = far(depth, pixels, seed, width=128, contexts=4)
    before, after = row["given"][0], row["left"][0]
    assert after < 0.15 and not row["left_out"] if row["accepted"] else after == before
    assert row["accepted"] or depth != "good", "good depth brings cameras back from here"
    if not row["accepted"]:
        assert "bundle adjustment" in row["reason"] or "do not agree clearly better" in row["reason"]
    assert summary([row])[0]["noise, px"] == f"{pixels:g}"


def test_photos_of_other_things_are_never_accepted(device):
    """No two photos show the same: nothing can be right, and the sentence says what to do."""
    from pagas_cl.method.cameras.refine import refine_cameras

    made, rng = relief_scene(96, 72, 5, held_out=0), np.random.default_rng(0)
    views = [View(camera, rng.integers(0, 255, (24, 32, 3), np.uint8).repeat(3, 0).repeat(3, 1), None, str(k))
             for k, camera in enumerate(made.views[k].camera for k in range(6))]
    found = refine_cameras(views, [made.initial_depth(view.camera) for view in views], device=device)
    assert not found.accepted and all(a is view.camera for a, view in zip(found.cameras, views))
    assert "colmap bundle_adjuster" in found.reason and "pixels can be brought back" in str(found)


def test_what_is_too_far():
    right, other = np.array([0.01, 0.02, 0.05, 0.03]), np.full(4, 0.15)
    for costs in (right, np.array([0.01, 0.02, 0.14, 0.03]), np.full(4, np.nan)):
        assert too_far(costs, other, 0.0, 3.0, 100) == ""
    assert too_far(np.full(4, 1e-4), np.full(4, 1e-4), 0.0, 3.0, 100) == ""         # blank photos
    assert too_far(right, other, 0.1, 0.0, 100) == "" != too_far(right, other, 0.1, 40.0, 100)
    assert "no offset of whole photos was found" in too_far(other, other, 0.0, 0.0, 100)
    reason = too_far(np.array([0.01, 0.14, 0.14, 0.03]), other, 0.0, 23.1, 160)
    assert "about 23 pixels off" in reason and "at best 20 pixels" in reason and "50%" in reason
    assert "more than can be measured" in too_far(right, other, 0.5, np.nan, 160)


def test_whole_photos_are_laid_upon_one_another():
    """Cameras that were rotated are rotated back, but for what all have in common; blank photos rotate none."""
    made = relief_scene(96, 72, 4, held_out=0)
    true = [view.camera for view in made.views]
    rng = np.random.default_rng(0)
    off = [rotated(camera, np.eye(3)) for camera in true]
    for k in (1, 3):
        w = rng.normal(size=3) * 0.03 * [1, 1, 0]
        off[k] = rotated(true[k], exponential(np.r_[w, 0, 0, 0])[0])
    photos = [view.load_image().mean(axis=2) for view in made.views]
    normals = [(photo - photo.mean()) / photo.std() for photo in photos]
    depths = [made.true_depth(camera) for camera in true]
    pairs = [(a, b) for a in range(5) for b in range(a)]
    rotations, pixels = initial_rotations(off, normals, depths, pairs)
    back = [rotated(camera, turn) for camera, turn in zip(off, rotations)]

    def apart(cameras):
        looks = [camera.direction @ true[k].direction for k, camera in enumerate(cameras)]
        return np.ptp(np.degrees(np.arccos(np.clip(looks, -1, 1)))) * np.pi / 180 * true[0].fx

    assert 1 < pixels < 8 and apart(back) < 0.5 * apart(off)
    still, none = initial_rotations(off, [np.full_like(photo, np.nan) for photo in photos], depths, pairs)
    assert np.isnan(none) and all(np.array_equal(turn, np.eye(3)) for turn in still)
