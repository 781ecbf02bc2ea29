"""Listing the devices from a child process, so that a driver that crashes while it is asked does not take us along."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from dataclasses import asdict

from pagas_cl.errors import DeviceError, NoDeviceError
from pagas_cl.runtime.device import DeviceInfo, find_devices, import_pyopencl, trial_fault


def list_devices(timeout: float = 60.0) -> list[DeviceInfo]:
    """Every OpenCL device of this machine, in the platforms' order.

    Raises
    ------
    DeviceError
        None is found, or a driver crashes or hangs while it is asked.
    """
    try:
        child = subprocess.run([sys.executable, "-m", "pagas_cl.runtime.listing"], timeout=timeout,
                               stdin=subprocess.DEVNULL, capture_output=True, text=True, errors="replace",
                               env={**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)})
    except subprocess.TimeoutExpired as error:
        raise DeviceError(f"an OpenCL driver did not answer within {timeout:g} s; set OCL_ICD_VENDORS to the .icd "
                          "file of one driver at a time to find which") from error
    if child.returncode < 0:
        raise DeviceError(f"an OpenCL driver crashed while its devices were listed ({_signal(-child.returncode)}); "
                          "set OCL_ICD_VENDORS to the .icd file of one driver at a time to find which")
    try:
        answer = json.loads(child.stdout.strip().splitlines()[-1])
    except (IndexError, ValueError) as error:
        last = (child.stderr.strip().splitlines() or ["no message"])[-1]
        raise DeviceError(f"the OpenCL devices cannot be listed: {last}") from error
    if "error" in answer:
        raise NoDeviceError(answer["error"])
    return [DeviceInfo(**{**d, "extensions": tuple(d["extensions"])}) for d in answer["devices"]]


def _signal(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


def _answer() -> str:
    """What the child process writes: the devices, each tried with a small kernel, or the sentence that says why there
    is none; one line of JSON."""
    try:
        cl = import_pyopencl()
        return json.dumps({"devices": [{**asdict(info), "fault": trial_fault(cl, device)}
                                       for info, device in find_devices(cl)]})
    except DeviceError as error:
        return json.dumps({"error": str(error)})


if __name__ == "__main__":
    sys.stdout.write("\n" + _answer() + "\n")
