"""Confidence becomes the vertex quality of a mesh that has none; a quality of the user's own stays."""

import numpy as np
import pytest

from pagas_cl.scene.mesh import Surface
from pagas_cl.scene.meshes.kinds import with_vertices
from pagas_cl.scene.meshes.meshlab_layer import CONFIDENCE

VERTICES = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
FACES = np.array([[0, 1, 2]], np.int32)
OWN, CONFIDENT = np.array([5.0, 6, 7]), np.array([0.25, 0.5, 1])


def surface(quality):
    return Surface(VERTICES, FACES, quality=quality)


def tensor(quality):
    o3d = pytest.importorskip("open3d")
    mesh = o3d.t.geometry.TriangleMesh()
    mesh.vertex["positions"], mesh.triangle["indices"] = o3d.core.Tensor(VERTICES), o3d.core.Tensor(FACES)
    if quality is not None:
        mesh.vertex["quality"] = o3d.core.Tensor(quality[:, None])
    return mesh


def meshlab(quality):
    pymeshlab = pytest.importorskip("pymeshlab")
    return pymeshlab.Mesh(VERTICES, FACES, **({} if quality is None else {"v_scalar_array": quality}))


READ = {surface: lambda mesh, name: mesh.quality if name is None else mesh.attributes[name],
        tensor: lambda mesh, name: mesh.vertex[name or "quality"].numpy()[:, 0],
        meshlab: lambda mesh, name: (mesh.vertex_scalar_array() if name is None else
                                     mesh.vertex_custom_scalar_attribute_array(name))}


@pytest.mark.parametrize("kind", READ, ids=lambda kind: kind.__name__)
def test_quality(kind, caplog):
    caplog.set_level("INFO")
    made = with_vertices(kind(None), VERTICES + 1, quality=CONFIDENT)
    assert np.array_equal(READ[kind](made, None), CONFIDENT) and not caplog.text
    made = with_vertices(kind(OWN), VERTICES + 1, quality=CONFIDENT)
    assert np.array_equal(READ[kind](made, None), OWN) and CONFIDENCE in caplog.text
    assert np.array_equal(READ[kind](made, CONFIDENCE), CONFIDENT)
    again = with_vertices(made, VERTICES + 2, quality=CONFIDENT / 2)
    assert np.array_equal(READ[kind](again, CONFIDENCE), CONFIDENT / 2)
    assert np.array_equal(READ[kind](again, None), OWN)
