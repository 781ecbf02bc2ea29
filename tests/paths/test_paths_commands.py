"""Every command but refine and tradeoff: each row of the table."""

import pytest
from paths.rows import check_row, named

from pagas_cl.__main__ import command_names

pytestmark = pytest.mark.slow

OTHERS = [command for command in command_names() if command not in ("refine", "tradeoff")]


@pytest.mark.parametrize("name", named("--version", *OTHERS))
def test_row(name, places, tmp_path):
    check_row(name, places, tmp_path)
