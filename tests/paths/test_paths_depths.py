"""From depth maps to depth maps and to a mesh: every column of the table that does so."""

import numpy as np
import pytest
from paths.matrix import Heard, check_column, chosen, label
from paths.run import in_terminal
from paths.truth import scenes_of_columns

from pagas_cl import find_depth, load_depth, preset, read_scene, refine_depth
from pagas_cl.scene.choice import PartnerChooser

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    return scenes_of_columns(tmp_path_factory.mktemp("scenes"))


@pytest.mark.filterwarnings("ignore:nothing was refined")      # with cameras that stay off
@pytest.mark.parametrize("number", chosen(["new", "maps"]), ids=label)
def test_column(number, scenes, tmp_path):
    check_column(number, scenes, tmp_path)


def test_one_view(scenes, tmp_path):
    """refine_depth with the views that the command chooses, with a function that progress is reported to and none."""
    scenes = scenes["0"]
    scene = scenes.path("0")
    in_terminal(["refine", str(scene), "--depth-dir", str(scene / "depth_initial"), "--no-align", "--views", "target",
                 "--effect", "agreement=off", "cameras=off", "--save-depth", str(tmp_path)]).must_end_well(0)
    views, config = read_scene(scene).views, preset("balanced").with_settings(effects__agreement="off")
    depths = [load_depth(find_depth(scene / "depth_initial", view.name)) for view in views]
    chosen_views = PartnerChooser([view.camera for view in views], depths, config.context).choose(0)
    contexts, held_out = ([views[k] for k in those] for those in (chosen_views.contexts, chosen_views.held_out))
    heard = Heard()
    for progress in (heard, None):
        found = refine_depth(views[0], contexts, depths[0], config=config, held_out=held_out, progress=progress)
        assert np.array_equal(found.depth, load_depth(tmp_path / "target.npz"))
    assert heard.stages
    true, before = scenes.made.true_depth(views[0].camera), depths[0]
    assert np.abs(found.depth - true).mean() < 0.6 * np.abs(before - true).mean()
