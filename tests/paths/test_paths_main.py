"""The main job as a photographer gives it, with no setting at all: cameras that are off, live progress, a better
surface."""

import pytest
from paths.run import in_terminal
from paths.table import ON_A_TERMINAL
from paths.truth import Scenes

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    return Scenes(tmp_path_factory.mktemp("scenes"))


def refined(scene, out, *start):
    ran = in_terminal(["refine", str(scene), *map(str, start), "--output", str(out / "made.ply"), "--save-depth",
                       str(out / "maps"), *ON_A_TERMINAL])
    ran.must_end_well(0)
    assert "━" in ran.raw and (out / "maps" / "cameras.json").is_file()


@pytest.mark.parametrize("off", "13")
def test_from_a_mesh(off, scenes, tmp_path):
    scene = scenes.path(off)
    refined(scene, tmp_path, "--mesh", scene / "mesh_coarse.ply")
    assert scenes.of_mesh(tmp_path / "made.ply", scenes.cameras) < 0.6 * scenes.before
    assert scenes.of_maps(tmp_path / "maps") < 0.6 * scenes.before


@pytest.mark.parametrize("off", "13")
def test_from_depth_maps(off, scenes, tmp_path):
    scene = scenes.path(off)
    refined(scene, tmp_path, "--depth-dir", scene / "depth_initial")
    assert scenes.of_maps(tmp_path / "maps") < 0.6 * scenes.before
