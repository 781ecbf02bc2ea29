"""From a mesh to the same mesh, refined or moved: every column of the table that does so."""

import pytest
from paths.matrix import check_column, chosen, label
from paths.truth import scenes_of_columns

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    return scenes_of_columns(tmp_path_factory.mktemp("scenes"))


@pytest.mark.filterwarnings("ignore:nothing was refined")      # with cameras that stay off
@pytest.mark.parametrize("number", chosen(["mesh", "keep"]), ids=label)
def test_column(number, scenes, tmp_path):
    check_column(number, scenes, tmp_path)
