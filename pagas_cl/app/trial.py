"""What a child process does to try a device: the checks of pagas_cl.app.device_check, then a whole view.

    python -m pagas_cl.app.trial '{"identity": [...], "lanes": 16}'

answers with one line of JSON: {"fault": "", "lasting": true}. `lasting` is false for what another try may mend.
"""

import json
import sys

import numpy as np

from pagas_cl.app.device_check import SETTINGS, STEPS, RecordedStep, outcomes
from pagas_cl.errors import DeviceError, KernelBuildError
from pagas_cl.method.view.one_view import refine_depth
from pagas_cl.runtime import device as devices
from pagas_cl.runtime.listing import find_devices
from pagas_cl.runtime.trial import identity
from pagas_cl.runtime.vendors import import_pyopencl
from pagas_cl.system.child import end_with_parent


def try_out(wanted: list, lanes: int) -> dict:
    """What is wrong with the device of that identity, with so many lanes."""
    cl = import_pyopencl()
    found = [pair for pair in find_devices(cl) if identity(pair[0]) == wanted]
    if not found:
        return {"fault": "it is no longer there", "lasting": False}
    try:
        device = devices.opened(*found[0], lanes)
        for outcome in outcomes(device):
            if outcome.faults:
                return {"fault": f"it computes wrongly ({outcome.name}: {'; '.join(outcome.faults)})", "lasting": True}
        return {"fault": _whole_view(device), "lasting": True}
    except KernelBuildError as error:
        return {"fault": f"its compiler fails ({error})", "lasting": True}
    except (cl.Error, DeviceError) as error:
        return {"fault": f"it fails ({devices.cause(error)})", "lasting": False}


def _whole_view(device) -> str:
    """What is wrong with a view refined as users do, its effects measured."""
    step = RecordedStep.load()
    # the settings of the gradient above as far as they shape programs: these are compiled already
    config = SETTINGS["order-free blend"].with_settings(**STEPS, effects__exposure="on")
    depth = step.initial * np.float32(step.scene_scale)
    result = refine_depth(step.target, step.contexts, depth, config=config, device=device)
    return "" if np.isfinite(result.depth).all() else "it computes wrongly (a refined depth is not finite)"


if __name__ == "__main__":
    end_with_parent()
    question = json.loads(sys.argv[1])
    sys.stdout.write("\n" + json.dumps(try_out(question["identity"], question["lanes"])) + "\n")
