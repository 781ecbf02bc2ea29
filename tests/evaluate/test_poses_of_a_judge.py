"""A photo that judges several depth maps, its pose fitted to each: each counts under the pose that suits it best."""

from dataclasses import replace

import numpy as np
from support.scenes import relief_scene

from pagas_cl.method.view.prediction import compare_predictions


def test_a_pose_that_ended_off_its_best_judges_nobody():
    made = relief_scene(96, 72, 1, held_out=0)
    target, other = made.views
    true, coarse = made.true_depth(target.camera), made.initial_depth(target.camera)
    pose = other.camera.world_to_camera.copy()
    pose[1, 3] += 3 * made.relief.footprint
    stuck = replace(other, camera=replace(other.camera, world_to_camera=pose))
    right = compare_predictions(target, [coarse, true], [other, other])
    found = compare_predictions(target, [coarse, true], [other, stuck])     # "fitted" to the true depth, and stuck
    assert [one.median for one in found] == [one.median for one in right]
    alone = compare_predictions(target, [coarse, true], stuck)
    assert alone[1].median < right[0].median < right[1].median
    nothing = compare_predictions(target, [np.zeros_like(true)], [other, stuck])[0]
    assert nothing.pixels == 0
