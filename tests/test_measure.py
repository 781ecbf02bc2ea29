"""Samples of the scene analysis against their float64 twin."""

from __future__ import annotations

import numpy as np
import pyopencl as cl
import pytest
from kernel_cases import Scene, view_of

from pagas_cl.config import BALANCED
from pagas_cl.errors import DeviceError
from pagas_cl.reference.level import prepare
from pagas_cl.reference.measure import UNDEFINED, shifted_cost
from pagas_cl.runtime.device import open_device
from pagas_cl.splat.level import LevelInput
from pagas_cl.splat.measure import SHIFTS, Probe
from pagas_cl.splat.state import PhotoStore


def test_costs_of_moved_depths_equal_the_twin():
    try:
        device = open_device()
    except DeviceError as error:
        pytest.skip(str(error))
    scene = Scene.make(17, width=45, height=37, contexts=2, masks=True)
    views, photos = [view_of(p) for p in (scene.target, *scene.contexts)], PhotoStore(device)
    given = LevelInput([v.camera for v in views], [photos.photo(v) for v in views], scene.unit, scene.delta(BALANCED), 1.0, 2)
    probe = Probe(device, BALANCED, given, lambda out: cl.enqueue_copy(device.queue, out, scene.initial))
    initial = scene.initial.astype(np.float64)
    state = prepare(initial, scene.target, scene.contexts, BALANCED, scene.unit, scene.delta(BALANCED))
    assert probe.stride == 1 and (probe.across, probe.down) == (45, 37)      # every pixel is a sample
    for number, context in enumerate(scene.contexts, start=1):
        got = probe.samples(number)
        seen = (got.state == 1).reshape(initial.shape)
        assert seen.mean() > 0.2
        for k, shift in enumerate(SHIFTS):
            want = shifted_cost(initial, state.parallax, scene.target, context, float(shift), scene.unit)[seen]
            cost = got.cost[:, k].reshape(initial.shape)[seen]
            same = (want == UNDEFINED) == (cost == UNDEFINED)
            assert same.mean() > 0.99                      # a patch pixel exactly on the photo's edge may fall either way
            assert np.quantile(np.abs(cost - want)[same], 0.99) < 1e-3
    probe.release()
