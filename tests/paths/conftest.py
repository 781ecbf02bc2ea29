"""What the tables of paths share."""

import pytest
from paths.truth import Scenes


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    return Scenes(tmp_path_factory.mktemp("scenes"))
