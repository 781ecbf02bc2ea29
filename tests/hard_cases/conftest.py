"""The device of the hard cases, and what is common to their tests."""

import pytest

from pagas_cl.errors import DeviceError
from pagas_cl.runtime.device import open_device


@pytest.fixture(scope="session")
def device():
    try:
        return open_device()
    except DeviceError as error:
        pytest.skip(str(error))
