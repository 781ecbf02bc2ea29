"""What is equal keeps its order, however many there are of it, and so does what is around a vertex."""

import numpy as np
import pytest
from twins import mesh_rings as twin

from pagas_cl.method.surface import mesh_rings
from pagas_cl.runtime.memory import download, upload

pytestmark = pytest.mark.kernels


@pytest.mark.parametrize("spread", [1, 30, 4000])
def test_numbers_are_grouped_in_their_order(device, spread):
    numbers = (np.random.default_rng(1).uniform(size=10_000) ** 3 * spread).astype(np.int32)      # the first ones often
    found = mesh_rings.grouped(device, upload(device, numbers), len(numbers), spread + 5)
    for buffer, expected in zip(found, twin.grouped(numbers, spread + 5)):
        assert np.array_equal(download(device, buffer, len(expected), np.int32), expected)


def test_rings_are_those_of_the_twin(device):
    """Of faces of which some have a corner twice, and vertices without any."""
    faces = np.random.default_rng(2).integers(0, 500, (2000, 3), dtype=np.int32)
    found = mesh_rings.rings_of(device, upload(device, faces), len(faces), 510)
    for name, expected in twin.rings_of(faces, 510).items():
        assert np.array_equal(download(device, found[name], expected.shape, np.int32), expected), name
