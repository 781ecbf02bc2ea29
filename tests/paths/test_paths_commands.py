"""Every command but refine and tradeoff: each row of the table."""

from contextlib import ExitStack

import pytest
from paths.places import Places
from paths.rows import check_row, named

from pagas_cl.__main__ import command_names

pytestmark = pytest.mark.slow

OTHERS = [command for command in command_names() if command not in ("refine", "tradeoff")]


@pytest.fixture(scope="module")
def places(tmp_path_factory, device):
    with ExitStack() as stack:
        yield Places(tmp_path_factory.mktemp("places"), device, stack)


@pytest.mark.parametrize("name", named("--version", *OTHERS))
def test_row(name, places, tmp_path):
    check_row(name, places, tmp_path)
