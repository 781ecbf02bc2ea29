"""Connected components on the device: those of the twin and of the host, whatever the mesh's shape."""

import numpy as np
import pytest
from twins import mesh_components as twin

from pagas_cl.method.surface.mesh_components import components_of
from pagas_cl.method.surface.weld import connected_components
from pagas_cl.scene.mesh import grid_faces

pytestmark = pytest.mark.kernels


@pytest.mark.parametrize("many", [50, 700, 1500])
def test_components_are_those_of_the_twin(device, many):
    faces = np.random.default_rng(4).integers(0, 3000, (many, 3), dtype=np.int32)
    found = components_of(device, faces, 3010)
    assert np.array_equal(found, twin.components_of(faces, 3010))
    assert np.array_equal(found, connected_components(faces, 3010))


def test_a_long_strip_and_a_sheet_are_one_component_each(device):
    strip = np.arange(100_000, dtype=np.int32)[:, None] + np.arange(3, dtype=np.int32)
    sheet = grid_faces(300, 300).astype(np.int32)
    for faces in (strip, strip[::-1].copy(), np.random.default_rng(5).permutation(strip), sheet):
        assert (components_of(device, faces, int(faces.max()) + 1) == 0).all()
