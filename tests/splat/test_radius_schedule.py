"""The radius of the last steps: `splatting.final_radius`."""

from __future__ import annotations

import numpy as np
import pytest
from support.scenes import relief_scene

from pagas_cl.config.presets import BALANCED
from pagas_cl.errors import InputError
from pagas_cl.method.splat import PhotoStore, ViewInput, refine_levels

SHORT = BALANCED.with_settings(pyramid__steps=(20,), splatting__radius=1.42)


@pytest.mark.slow
@pytest.mark.parametrize("blend", ["order_free", "alpha"])
def test_the_second_half_has_the_final_radius(device, blend):
    made = relief_scene(80, 60, 3, held_out=0)
    target, *others = made.views
    initial = made.initial_depth(made.cameras[0])

    def refined(radius):
        config = SHORT.with_settings(splatting__blend=blend, splatting__final_radius=radius)
        return refine_levels(ViewInput(target, others, initial, device, PhotoStore(device)), config).depth

    same, narrow = refined(1.42), refined(0.9)
    assert (same == refined(0.0)).all()
    assert (narrow != same).any() and np.abs(narrow - same).max() < 2 * made.relief.parallax


def test_it_never_grows():
    with pytest.raises(InputError, match="splatting.final_radius is 1.5"):
        SHORT.with_settings(splatting__final_radius=1.5)
