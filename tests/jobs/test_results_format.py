"""Results that differ from those of before have another RESULTS_FORMAT, so that no run goes on from earlier views.

    python tests/jobs/test_results_format.py      # stores the digests of this device, once RESULTS_FORMAT is raised

Floating point may differ between drivers, processors and versions of NumPy, so digests are stored by device.
"""

import hashlib
import json
import sys
from pathlib import Path

import numpy as np
import pytest

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from support.scenes import relief_scene

from pagas_cl.config.presets import preset
from pagas_cl.jobs.task import RESULTS_FORMAT
from pagas_cl.refine import refine_views
from pagas_cl.runtime.device import open_device

STORED = Path(__file__).with_name("results_format.json")
PRESETS = ("fast", "balanced")
STEPS = 6             # most of each level: enough that every kernel of a preset has run


def device_key(device) -> str:
    """What floating point depends on: platform, device, driver, lanes, NumPy and its vector instructions."""
    found = ", ".join(np.show_config(mode="dicts")["SIMD Extensions"]["found"])
    info = device.info
    return f"{info.platform}; {info.name}; driver {info.driver}; {device.lanes} lanes; NumPy {np.__version__} ({found})"


def digest(arrays) -> str:
    """Of arrays, in their order."""
    found = hashlib.sha256()
    for array in arrays:
        found.update(np.ascontiguousarray(array).tobytes())
    return found.hexdigest()[:24]


def digests(device) -> dict[str, str]:
    """Of the inputs, and of what each preset makes of them."""
    scene = relief_scene(64, 48, 3, held_out=0)
    depths = [scene.initial_depth(view.camera) for view in scene.views]
    found = {"inputs": digest([*depths, *(view.load_image() for view in scene.views)])}
    for name in PRESETS:
        config = preset(name)
        steps = tuple(min(count, STEPS) for count in config.pyramid.steps)
        results = refine_views(scene.views, depths, config=config.with_settings(pyramid__steps=steps), device=device)
        found[name] = digest(array for result in results
                             for array in (result.depth, result.status, result.deviation, result.parallax))
    return found


def test_results_are_those_of_their_format(device):
    stored, key = json.loads(STORED.read_text()), device_key(device)
    assert stored["format"] == RESULTS_FORMAT, f"store the new digests with python tests/jobs/{Path(__file__).name}"
    if key not in stored["devices"]:
        pytest.skip(f"no digests are stored of {key}: python tests/jobs/{Path(__file__).name} stores them")
    expected, found = stored["devices"][key], digests(device)
    assert found["inputs"] == expected["inputs"], "the made scene is another one: store the new digests"
    assert found == expected, ("results have changed: raise RESULTS_FORMAT and store the new digests with "
                               f"python tests/jobs/{Path(__file__).name}")


def store() -> None:
    """Store this device's digests; those of an earlier format are removed."""
    device = open_device()
    stored, key = json.loads(STORED.read_text()) if STORED.exists() else {}, device_key(device)
    devices = stored["devices"] if stored.get("format") == RESULTS_FORMAT else {}
    found, before = digests(device), devices.get(key)
    if before and before["inputs"] == found["inputs"] and before != found:
        raise SystemExit("results have changed: raise RESULTS_FORMAT (pagas_cl/jobs/task.py) first")
    devices[key] = found
    STORED.write_text(json.dumps({"format": RESULTS_FORMAT, "devices": devices}, indent=1, sort_keys=True) + "\n")
    print(f"stored: {key}")


if __name__ == "__main__":
    store()
