"""Two depth maps to start from, against the float64 twin; that photos decide: test_hypotheses.py."""

import numpy as np
import pytest
from twins import starts as twin

from pagas_cl.method.splat.starts import better_of, places
from pagas_cl.runtime.memory import download, upload
from pagas_cl.scene.camera import Size

pytestmark = pytest.mark.kernels


@pytest.mark.parametrize("width, height", [(40, 30), (41, 31), (1, 2)])
def test_of_two_starts_each_place_gets_what_its_twin_takes(device, width, height):
    random = np.random.default_rng(0)
    one, other = ((random.random((height, width)) > 0.2) * random.integers(1, 4, (height, width)).astype(np.float32)
                  for _ in range(2))
    costs = random.random((2, -(-height // 2) * -(-width // 2))).astype(np.float32)
    expected = twin.better_of(one, other, *costs)
    found = better_of(device, Size(width, height), [upload(device, one), upload(device, other)],
                      [upload(device, cost) for cost in costs])
    np.testing.assert_array_equal(found, expected)
    listed, count = places(device, Size(width, height))
    compared = np.arange(one.size).reshape(one.shape)[::twin.STEP, ::twin.STEP].ravel()
    np.testing.assert_array_equal(download(device, listed, count, np.int32), compared)
    if width > 1:
        assert (found != one).any() and (found != other).any()


def test_a_thin_thing_is_decided_by_its_own_places(device):
    """A bar two pixels wide, all of whose places match better as given: most places around are of what is behind it."""
    one, other = np.full((12, 12), 2.0, np.float32), np.full((12, 12), 2.1, np.float32)
    one[:, 4:6] = 1
    costs = np.zeros((2, 6, 6), np.float32)
    costs[0] = 1 - (one[::2, ::2] == 1)
    costs[1] = 0.5
    found = better_of(device, Size(12, 12), [upload(device, one), upload(device, other)],
                      [upload(device, cost.ravel()) for cost in costs])
    np.testing.assert_array_equal(found, np.where(one == 1, one, other))
