"""An importing program owns its process: the library leaves it unchanged, and works on the caller's own queue."""

import json
import os
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from support.scenes import relief_scene

from pagas_cl import Device, preset, refine_depth, refine_mesh
from pagas_cl.errors import DeviceError, InputError
from pagas_cl.runtime import device as devices
from pagas_cl.runtime.device import working
from pagas_cl.runtime.program import COMMON

ROOT = Path(__file__).resolve().parents[2]
STATE = """
import json, locale, logging, os, signal, sys, threading, warnings
import numpy as np
sys.path.insert(0, sys.argv[1])

def state():
    umask = os.umask(0)
    os.umask(umask)
    loggers = {name: logging.getLogger(name) for name in ("", "pagas_cl")}
    return {
        "environment": dict(os.environ), "umask": umask, "folder": os.getcwd(), "path": sys.path[:],
        "signals": {s.name: repr(signal.getsignal(s)) for s in sorted(signal.valid_signals())
                    if isinstance(s, signal.Signals)},
        "warnings": [repr(one) for one in warnings.filters], "shown by": repr(warnings.showwarning),
        "logging": {name: [repr(one.handlers), one.level, one.propagate, one.disabled]
                    for name, one in loggers.items()},
        "all logging": logging.root.manager.disable, "locale": locale.setlocale(locale.LC_ALL),
        "hooks": [repr(hook) for hook in (sys.excepthook, threading.excepthook, sys.unraisablehook)],
        "streams": [repr(one) for one in (sys.stdin, sys.stdout, sys.stderr)],
        "threads": sorted(thread.name for thread in threading.enumerate()), "random": repr(np.random.get_state()),
        "NumPy errors": np.geterr(), "recursion": sys.getrecursionlimit()}

before = state()
import pagas_cl
from support.scenes import relief_scene
scene = relief_scene(64, 48, 3, held_out=0)
settings = pagas_cl.preset("fast").with_settings(pyramid__steps=(3,))
refined = pagas_cl.refine_mesh(scene.initial_mesh(), [view.camera for view in scene.views],
                               [view.load_image() for view in scene.views], config=settings)
print(json.dumps([before, state()]))
"""


def test_the_process_is_left_as_it_was(device, tmp_path):
    """In a process of its own: before pagas_cl is imported, and after a mesh was refined."""
    paths = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run([sys.executable, "-c", STATE, str(ROOT / "tests")], capture_output=True, text=True,
                          cwd=tmp_path, env={**os.environ, "PYTHONPATH": paths, "LC_ALL": "C.UTF-8"})
    assert done.returncode == 0, done.stderr
    before, after = json.loads(done.stdout.splitlines()[-1])
    assert before == after


@pytest.fixture(scope="module")
def scene():
    return relief_scene(96, 72, 3, held_out=0)


def refined(scene, device):
    config = preset("balanced").with_settings(pyramid__steps=(5,))
    target, *contexts = scene.views
    return refine_depth(target, contexts, scene.initial_depth(target.camera), config=config, device=device)


@pytest.mark.kernels
def test_a_callers_own_queue_gives_the_same_bytes(device, scene):
    import pyopencl as cl

    context = cl.Context([device.cl_device])
    queue = cl.CommandQueue(context)
    own = Device.of(queue)
    assert (own.queue, own.context, own.lanes, own.info) == (queue, queue.context, device.lanes, device.info)
    expected, found = refined(scene, device), refined(scene, own)
    assert all(np.array_equal(getattr(found, name), getattr(expected, name))
               for name in ("depth", "status", "deviation", "parallax"))
    assert own.memory.held == 0 and own.programs, "it worked there, and nothing but programs is left"
    assert [name for name, *_ in own.programs].count(COMMON) == 1, "what no setting changes is compiled once"


@pytest.mark.kernels
def test_a_mesh_is_refined_on_the_callers_queue_alone(device, scene, monkeypatch):
    import pyopencl as cl

    context = cl.Context([device.cl_device])
    own = Device.of(cl.CommandQueue(context))
    monkeypatch.setattr(devices, "opened", lambda *_: pytest.fail("another context is opened"))
    monkeypatch.setattr(devices, "_open_devices", threading.local())
    config = preset("fast").with_settings(pyramid__steps=(3,), effects__cameras="on")
    mesh, cameras = scene.initial_mesh(), [view.camera for view in scene.views]
    vertices, _ = refine_mesh(mesh, cameras, [view.load_image() for view in scene.views], config=config, device=own)
    assert np.isfinite(vertices).all()


@pytest.mark.kernels
def test_a_callers_queue_is_not_replaced_where_it_is_lost(device):
    import pyopencl as cl

    context = cl.Context([device.cl_device])
    own = Device.of(cl.CommandQueue(context))
    assert working(own) is own
    own.is_lost = True
    with pytest.raises(DeviceError, match="the caller's queue .* has failed"):
        working(own)


@pytest.mark.kernels
def test_a_queue_may_outlive_its_context_or_is_refused(device):
    import pyopencl as cl

    queue = cl.CommandQueue(cl.Context([device.cl_device]))     # nobody keeps the context
    try:
        assert Device.of(queue).context == queue.context
    except InputError as error:
        assert "keep the pyopencl.Context as long as the queue" in str(error)


@pytest.mark.kernels
def test_what_is_no_queue_for_the_work_is_refused(device):
    import pyopencl as cl

    with pytest.raises(InputError, match="queue is a Context, expected a pyopencl.CommandQueue"):
        Device.of(device.context)
    out_of_order = cl.command_queue_properties.OUT_OF_ORDER_EXEC_MODE_ENABLE
    if device.cl_device.queue_properties & out_of_order:
        with pytest.raises(InputError, match="out of order"):
            Device.of(cl.CommandQueue(device.context, properties=out_of_order))
