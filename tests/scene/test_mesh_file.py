"""Mesh files: what is written is read back, by Open3D and by MeshLab."""

from dataclasses import replace

import numpy as np
import pytest

from pagas_cl.errors import InputError
from pagas_cl.scene.mesh import Surface, from_legacy
from pagas_cl.scene.mesh_file import SUFFIXES, read_mesh, read_open3d, write_mesh


@pytest.fixture
def surface():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]) + (450123.4567, 0, -4649876.5432)
    normals = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0.8, 0]])
    colors = np.array([[0, 0, 0], [1, 1, 1], [0.2, 0.4, 0.6], [1 / 255, 2 / 255, 3 / 255]])
    return Surface(vertices, [[0, 2, 1], [0, 1, 3], [0, 3, 2]], normals, colors, np.array([0, 0.25, 0.5, 1]))


def test_ply_keeps_everything(surface, tmp_path):
    surface = replace(surface, attributes={"part": np.array([1.0, 2, 3, 4]), "s": np.array([0, 0.25, 0.5, 0.75])})
    path = tmp_path / "new" / "a.ply"
    write_mesh(path, surface)
    read = read_mesh(path)
    assert (read.vertices == surface.vertices).all() and (read.faces == surface.faces).all()
    assert np.abs(read.normals - surface.normals).max() < 1e-6 and np.abs(read.colors - surface.colors).max() < 1e-6
    assert (read.quality == surface.quality).all() and list(read.attributes) == ["part", "s"]
    assert all((read.attributes[name] == surface.attributes[name]).all() for name in read.attributes)
    assert [p.name for p in path.parent.iterdir()] == ["a.ply"]


def test_ply_is_what_open3d_reads(surface, tmp_path):
    pytest.importorskip("open3d")
    write_mesh(tmp_path / "a.ply", surface)
    read, other = read_mesh(tmp_path / "a.ply"), from_legacy(read_open3d(tmp_path / "a.ply"))
    for name in ("vertices", "faces", "normals", "colors"):
        assert (getattr(read, name) == getattr(other, name)).all()


@pytest.mark.parametrize("change", [
    ("little_endian", "big_endian"), ("end_header\n", "end_header\r\n"), ("vertex_indices", "vertex_index"),
    ("vertex_indices", "corners"), ("uchar int vertex", "uchar float vertex"), ("float quality", "float red"),
    ("float quality", "unknown quality"), ("property double z\n", ""), ("element face", "element edge"),
    ("float quality", "list uchar int quality"), ("\x03", "\x04"), ("\x03", "\xff"), ("end_header", "end")])
def test_damaged_ply_is_an_error_or_open3d_reads_it(surface, tmp_path, change):
    pytest.importorskip("open3d")
    write_mesh(tmp_path / "a.ply", surface)
    old, new = (text.encode("latin-1") for text in change)
    header, end, data = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    parts = (header, end, data.replace(old, new)) if old == b"\x03" else ((header + end).replace(old, new), data)
    (tmp_path / "a.ply").write_bytes(b"".join(parts))
    try:
        assert len(read_mesh(tmp_path / "a.ply").vertices) == 4
    except InputError as error:
        assert "a.ply" in str(error)


def test_meshlab_finds_the_quality(surface, tmp_path):
    pymeshlab = pytest.importorskip("pymeshlab")
    write_mesh(tmp_path / "a.ply", surface)
    meshes = pymeshlab.MeshSet()
    meshes.load_new_mesh(str(tmp_path / "a.ply"))
    mesh = meshes.current_mesh()
    assert (mesh.vertex_matrix() == surface.vertices).all()
    assert (mesh.vertex_scalar_array() == surface.quality).all()
    assert np.abs(mesh.vertex_color_matrix()[:, :3] - surface.colors).max() < 1e-6


@pytest.mark.parametrize("suffix", [s for s in SUFFIXES if s != ".ply"])
def test_other_kinds_go_through_open3d(surface, tmp_path, suffix):
    pytest.importorskip("open3d")
    small = Surface(surface.vertices - surface.vertices[0], surface.faces, colors=surface.colors)
    write_mesh(tmp_path / f"a{suffix}", small)
    read = read_mesh(tmp_path / f"a{suffix}")
    assert len(read.faces) == 3 and np.ptp(read.vertices, axis=0) == pytest.approx([1, 1, 1])


def test_names_that_cannot_be_written(surface, tmp_path):
    with pytest.raises(InputError, match="unknown kind '.xyz', expected one of .ply"):
        write_mesh(tmp_path / "a.xyz", surface)
    (tmp_path / "b.ply").mkdir()
    with pytest.raises(InputError, match="is a folder"):
        write_mesh(tmp_path / "b.ply", surface)
