"""Fixtures of the tests of whole paths."""

from contextlib import ExitStack

import pytest
from paths.places import Places


@pytest.fixture(scope="module")
def places(tmp_path_factory, device):
    with ExitStack() as stack:
        yield Places(tmp_path_factory.mktemp("places"), device, stack)
