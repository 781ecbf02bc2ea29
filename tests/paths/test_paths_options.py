"""Options of refine that the table's MATRIX has not got, and tradeoff."""

from contextlib import ExitStack

import pytest
from paths.places import Places
from paths.rows import check_row, named

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def places(tmp_path_factory, device):
    with ExitStack() as stack:
        yield Places(tmp_path_factory.mktemp("places"), device, stack)


@pytest.mark.parametrize("name", named("refine", "tradeoff"))
def test_row(name, places, tmp_path):
    check_row(name, places, tmp_path)
