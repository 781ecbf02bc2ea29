"""What the driver says when a device fails in the middle of work, as errors of one sentence."""

from collections.abc import Iterator
from contextlib import contextmanager

import pyopencl as cl

from pagas_cl.errors import DeviceLostError, DeviceMemoryError
from pagas_cl.runtime.device import Device, give_up

_codes = cl.status_code
_MEMORY = {_codes.MEM_OBJECT_ALLOCATION_FAILURE, _codes.OUT_OF_HOST_MEMORY}
_LOST = {_codes.OUT_OF_RESOURCES, _codes.DEVICE_NOT_AVAILABLE, _codes.DEVICE_NOT_FOUND, _codes.INVALID_DEVICE,
         _codes.INVALID_COMMAND_QUEUE, _codes.INVALID_CONTEXT, _codes.EXEC_STATUS_ERROR_FOR_EVENTS_IN_WAIT_LIST}
_OF_DRIVERS = -9999       # NVIDIA's code for an access that its hardware refused; below -1000 each maker has its own


@contextmanager
def translate_cl_errors(device: Device, doing: str) -> Iterator[None]:
    """Context: errors of the driver while `doing` (a noun phrase) on `device`, as ours; others as they are.

    DeviceMemoryError: it has no memory left, fewer buffers may do. DeviceLostError: it answers no more, or has ended
    what it was at; its context is given up.
    """
    title = device.info.title
    try:
        yield
    except cl.Error as error:
        code = getattr(error, "code", 0)
        if code in _MEMORY:
            raise DeviceMemoryError(f"{title} ran out of memory during {doing} ({error})") from error
        if code in _LOST or code <= _OF_DRIVERS:
            give_up(device)
            raise DeviceLostError(f"{title} failed during {doing} ({error}): start the same command again, which goes "
                                  "on from the views that are on disk; where it fails again, update its driver or "
                                  "choose another device (pagas-cl devices)") from error
        raise
