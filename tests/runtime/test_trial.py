"""A device is believed only after a step of pagas_cl was built and run on it: with drivers that are made to fail."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from support import recorded_step

from pagas_cl.app import device_check as made_by_the_child
from pagas_cl.app.device_check import RecordedStep
from pagas_cl.errors import InputError, NoDeviceError
from pagas_cl.runtime import cache, listing, trial, vendors
from pagas_cl.runtime.info import DeviceInfo
from pagas_cl.runtime.trial import Trial, try_device
from pagas_cl.system import child
from pagas_cl.system.child import Answer

CPU = DeviceInfo("P", "D", "CPU", driver="1.0", vector_width=16)
COMPILED = str(Path.home() / ".cache" / "pocl" / "kcache")        # where PoCL keeps what it has compiled
OPEN = "from pagas_cl.runtime.device import open_device; d = open_device(); print('opened', d.lanes, d.info.driver)"


@pytest.fixture
def own_cache(monkeypatch, tmp_path):
    monkeypatch.setattr(cache, "folder", lambda: tmp_path / "cache")
    monkeypatch.setattr(cache, "_in_memory", {})
    for name in (trial.LANES, trial.LIMIT, trial.KNOWN, vendors.VARIABLE):
        monkeypatch.setenv(name, "")           # so that what a test sets is taken back
        monkeypatch.delenv(name)
    return tmp_path / "cache"


@pytest.fixture
def calls(monkeypatch, own_cache):
    """The (lanes, limit) of each child, which answers as `calls.answers` (lanes -> Answer) says."""
    class Calls(list):
        answers: dict = {}

    made = Calls()

    def ask(module, question, limit, environment=None):
        made.append((question["lanes"], limit))
        return made.answers.get(question["lanes"], Answer({"fault": "", "lasting": True}))

    monkeypatch.setattr(child, "ask", ask)
    return made


def test_a_trial_is_made_once_for_a_driver_and_its_kernels(calls, monkeypatch, own_cache):
    assert try_device(CPU).lanes == 16 and try_device(CPU).lanes == 16 and len(calls) == 1
    assert try_device(DeviceInfo("P", "D", "CPU", driver="1.1", vector_width=16)).lanes == 16 and len(calls) == 2
    assert try_device(CPU, again=True).lanes == 16 and len(calls) == 3
    monkeypatch.setattr(trial, "kernels", lambda: "others")
    monkeypatch.setenv(trial.KNOWN, "known")
    assert try_device(CPU).lanes == 16 and len(calls) == 3       # whoever edits kernels wants the tests to judge them
    monkeypatch.delenv(trial.KNOWN)
    assert try_device(CPU).lanes == 16 and len(calls) == 4
    for path in (own_cache / "devices").iterdir():
        path.write_text("{")
    assert try_device(CPU).lanes == 16 and len(calls) == 5       # a damaged file counts as none


@pytest.mark.parametrize("width, cap, tried", [(16, "16", (16, 8, 4, 1)), (8, "16", (8, 4, 1)), (1, "16", (1,)),
                                               (16, "4", (4, 1)), (16, "1", (1,))])
def test_fewer_lanes_are_tried_in_turn(calls, monkeypatch, width, cap, tried):
    calls.answers = {lanes: Answer(None, "crashed (SIGABRT: x)", crashed=True) for lanes in (16, 8, 4)}
    monkeypatch.setenv(trial.LANES, cap)
    found = try_device(DeviceInfo("P", "D", "CPU", vector_width=width))
    assert tuple(lanes for lanes, _ in calls) == tried and found.lanes == 1
    assert not found.fault or "its driver crashed (SIGABRT: x)" in found.fault


def test_after_a_compiler_that_hangs_one_lane_is_tried_and_no_more(calls):
    calls.answers = {16: Answer(None, "gave no answer within 180 s", hung=True)}
    assert try_device(CPU) == Trial(1, "with 16 lanes its driver gave no answer within 180 s", try_device(CPU).seconds)
    assert calls == [(16, 180.0), (1, 180.0)]


@pytest.mark.parametrize("answer, fault", [
    (Answer({"fault": "it fails (OUT_OF_RESOURCES)", "lasting": False}), "it fails (OUT_OF"),
    (Answer(None, 'crashed (SIGABRT: error: unable to execute command: Executable "ld" doesn\'t exist!)', crashed=True),
     "its driver crashed (SIGABRT")])
def test_a_device_that_was_busy_or_lacked_its_linker_is_tried_again_the_next_time(calls, answer, fault):
    calls.answers = dict.fromkeys(trial.WIDTHS, answer)
    assert try_device(CPU).lanes == 0 and f"with 16, 8, 4 and 1 lanes {fault}" in try_device(CPU).fault
    calls.answers = {}
    assert try_device(CPU).lanes == 16


def test_without_a_disk_it_is_known_for_this_process(calls, monkeypatch):
    def full(path, text):
        raise OSError("No space left on device")

    monkeypatch.setattr(cache, "write_whole", full)
    assert try_device(CPU).lanes == 16 and try_device(CPU).lanes == 16 and len(calls) == 1


@pytest.mark.parametrize("name, value", [
    (trial.LANES, "3"), (trial.LANES, "x"), (trial.LIMIT, "0"), (trial.LIMIT, "no")])
def test_environment_that_is_wrong(calls, monkeypatch, name, value):
    monkeypatch.setenv(name, value)
    with pytest.raises(InputError, match=name):
        try_device(CPU)


def test_the_recorded_step_is_that_of_the_twins():
    """Else python tests/support/recorded_step.py writes it anew."""
    step = RecordedStep.load()
    for want, got in zip(recorded_step.twin_gradients(step), step.gradients.values(), strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-5, atol=1e-6 * np.abs(want).max())


def test_the_child_reports_a_device_that_is_gone():
    assert made_by_the_child.try_out(["nobody"], 1) == {"fault": "it is no longer there", "lasting": False}


def test_a_child_lists_the_devices_of_drivers_first(monkeypatch, own_cache, tmp_path):
    files = [str(tmp_path / name) for name in ("bad.icd", "good.icd")]
    for name in files:
        Path(name).write_text("libx.so\n")
    monkeypatch.setattr(vendors, "icd_files", lambda: files)
    settings = []

    def ask(module, question, limit, environment=None):
        setting = (environment or {}).get(vendors.VARIABLE, "")
        settings.append(setting)
        names = [Path(setting).name] if setting.endswith(".icd") else os.listdir(setting) if setting else ["bad.icd"]
        return Answer(None, "crashed", crashed=True) if "bad.icd" in names else Answer({})

    monkeypatch.setattr(listing, "ask", ask)
    for _ in range(2):      # the second answer is cached, also for other processes
        assert os.listdir(listing.usable_drivers()) == ["good.icd"] and len(settings) == 4
        listing._usable.cache_clear()
    assert vendors.VARIABLE not in os.environ


def test_where_no_file_names_drivers_that_all_crash_is_found_out_anew(monkeypatch, own_cache):
    """As on Windows, whose drivers are in its registry: the next one may be another."""
    answers = [Answer(None, "ended with status 3221225477", crashed=True), Answer({})]
    monkeypatch.setattr(vendors, "icd_files", list)
    monkeypatch.setattr(listing, "ask", lambda *_: answers.pop(0))
    with pytest.raises(NoDeviceError, match="every OpenCL driver here crashes"):
        listing.usable_drivers()
    assert listing.usable_drivers() is None
    listing._usable.cache_clear()


def test_intels_runtime_from_pip_is_registered_next_to_the_systems_drivers(monkeypatch, own_cache, tmp_path):
    system = tmp_path / "pocl.icd"
    system.write_text("libpocl.so.2\n")
    monkeypatch.setattr(vendors, "system_files", lambda: [str(system)])
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(vendors, "intel_library", lambda: tmp_path / "libintelocl.so")
    with vendors.registered():
        folder = Path(os.environ[vendors.VARIABLE])
    assert vendors.VARIABLE not in os.environ                      # restored
    assert {path.name: path.read_text() for path in folder.iterdir()} == {
        "pocl.icd": "libpocl.so.2\n", "pagas_cl-intel-cpu.icd": f"{tmp_path / 'libintelocl.so'}\n"}
    monkeypatch.setenv(vendors.VARIABLE, "mine")
    with vendors.registered():
        assert os.environ[vendors.VARIABLE] == "mine"              # the user has chosen
    assert os.environ[vendors.VARIABLE] == "mine"
    monkeypatch.delenv(vendors.VARIABLE)
    system.write_text("/opt/intel/libintelocl.so\n")
    with vendors.registered():
        assert vendors.VARIABLE not in os.environ                  # the system has it already


@pytest.mark.kernels
@pytest.mark.parametrize("first", ["open3d", "pymeshlab"])
@pytest.mark.parametrize("inherited", [False, True])
def test_intels_runtime_opens_after_a_library_with_threads_of_the_same_name(first, inherited):
    """Both bring an older libtbb.so.12; a child process has the folder of drivers from its parent."""
    pytest.importorskip(first, reason=f"{first} is not installed", exc_type=ImportError)
    if vendors.intel_library() is None:
        pytest.skip("Intel's runtime is not installed by pip (make setup CPU=intel)")
    environment = {name: value for name, value in os.environ.items() if name != vendors.VARIABLE}
    if inherited:
        environment[vendors.VARIABLE] = vendors.folder_of([], {"x.icd": f"{vendors.intel_library()}\n"})
    code = f"import {first}\nfrom pagas_cl.runtime.device import open_device\nprint(open_device('Intel(R)').lanes)"
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert done.returncode == 0 and int(done.stdout) > 0, done.stderr


@pytest.fixture(scope="session")
def faulty_driver(tmp_path_factory):
    """A library that stands in front of the OpenCL loader and makes drivers fail."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if not compiler or not sys.platform.startswith("linux"):
        pytest.skip("needs a C compiler and LD_PRELOAD")
    library = tmp_path_factory.mktemp("driver") / "faulty_driver.so"
    source = Path(__file__).parents[1] / "support" / "faulty_driver.c"
    subprocess.run([compiler, "-shared", "-fPIC", "-o", library, source, "-ldl"], check=True)
    return library


def run_with(faulty_driver, folder, **environment) -> subprocess.CompletedProcess:
    """Open a device behind the faulty driver, with empty caches but for the compiler's own, which it stands before."""
    kept = {name: value for name, value in os.environ.items() if name not in (trial.LANES, trial.KNOWN)}
    return subprocess.run([sys.executable, "-c", OPEN], capture_output=True, text=True, timeout=500,
                          env={**kept, "LD_PRELOAD": str(faulty_driver), "XDG_CACHE_HOME": str(folder),
                               "POCL_CACHE_DIR": os.environ.get("POCL_CACHE_DIR", COMPILED), **environment})


def verdicts(folder) -> list[dict]:
    return [json.loads(path.read_text()) for path in (folder / "pagas_cl" / "devices").iterdir()]


@pytest.mark.slow
def test_a_compiler_that_aborts_with_vectors_serves_with_fewer_lanes(device, faulty_driver, tmp_path):
    if device.lanes == 1:
        pytest.skip("the device has one lane anyway")
    run = run_with(faulty_driver, tmp_path, FAULT="abort", FAULT_AT="COLUMNS=4", FAULT_IN=device.info.driver,
                   PAGAS_CL_LANES="4", PAGAS_CL_DEVICE=device.info.title)
    assert run.returncode == 0 and run.stdout.startswith("opened 1 "), run.stderr
    assert "with 4 lanes its driver crashed (SIGABRT: LLVM ERROR: Cannot select" in verdicts(tmp_path)[0]["fault"]


@pytest.mark.slow
@pytest.mark.parametrize("fault, message", [
    ("abort", "its driver crashed (SIGABRT: LLVM ERROR: Cannot select: fsqrt)"),
    ("wrong", "it computes wrongly (order-free blend: gradient differs from the recorded one by"),
    ("hang", "its driver gave no answer within 5 s")])
def test_a_driver_that_fails_is_passed_over_with_a_sentence(device, faulty_driver, tmp_path, fault, message):
    limits = {trial.LIMIT: "5"} if fault == "hang" else {}
    run = run_with(faulty_driver, tmp_path, FAULT=fault, PAGAS_CL_LANES="1", FAULT_IN=device.info.driver,
                   PAGAS_CL_DEVICE=device.info.title, **limits)
    assert run.returncode == 1, run.stdout          # an exception, not a signal
    assert "DeviceError: no OpenCL device that matches works" in run.stderr and message in run.stderr
    assert "devices --again" in run.stderr


@pytest.mark.slow
def test_a_driver_that_crashes_when_it_is_listed_takes_nobody_along(device, faulty_driver, tmp_path):
    run = run_with(faulty_driver, tmp_path, FAULT="list")
    assert run.returncode == 1 and "every OpenCL driver here crashes or hangs" in run.stderr, run.stderr
