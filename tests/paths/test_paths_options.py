"""Options of refine that the table's MATRIX has not got, and tradeoff."""

import pytest
from paths.rows import check_row, named

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("name", named("refine", "tradeoff"))
def test_row(name, places, tmp_path):
    check_row(name, places, tmp_path)
