"""Choosing a device, with a pyopencl that is made of plain objects, and once with the real one."""

import logging
import sys
from dataclasses import replace
from types import SimpleNamespace

import pytest

from pagas_cl.errors import DeviceError
from pagas_cl.runtime import allocations, listing, vendors  # noqa: F401  (before pyopencl is replaced)
from pagas_cl.runtime.device import Device, open_device
from pagas_cl.runtime.info import DeviceInfo
from pagas_cl.runtime.listing import find_devices
from pagas_cl.runtime.trial import Trial
from pagas_cl.runtime.vendors import import_pyopencl
from pagas_cl.system.child import ask

GPU, CPU, ACCELERATOR = 4, 2, 8


class ClError(Exception):
    """Stands for pyopencl.Error."""


def device(name, kind=GPU, units=10, **more):
    return SimpleNamespace(**{
        "name": name, "type": kind, "vendor": "vendor ", "version": "OpenCL 3.0 ", "driver_version": "1.2.3",
        "opencl_c_version": "OpenCL C 1.2 ", "global_mem_size": 2**33, "max_mem_alloc_size": 2**31,
        "local_mem_size": 48 * 1024, "max_work_group_size": 1024, "max_compute_units": units,
        "native_vector_width_float": 1, "extensions": "cl_khr_fp64 cl_khr_int64_base_atomics", "available": 1,
        "compiler_available": 1, "endian_little": 1, **more})


def platform(name, *devices):
    return SimpleNamespace(name=name, get_devices=lambda: list(devices))


@pytest.fixture
def machine(monkeypatch):
    """A function that puts platforms into a mocked pyopencl; `faults` of trials by device name."""
    monkeypatch.delenv("PAGAS_CL_DEVICE", raising=False)
    monkeypatch.setattr(listing, "usable_drivers", lambda: None)

    def install(*platforms, get_platforms=None, Context=lambda devices: devices[0], faults=None):
        def tried(info, again=False):
            fault = (faults or {}).get(info.name, "")
            return Trial(0 if fault else 1, fault)

        monkeypatch.setattr("pagas_cl.runtime.device.try_device", tried)
        fake = SimpleNamespace(
            Error=ClError, Context=Context, get_platforms=get_platforms or (lambda: list(platforms)),
            device_type=SimpleNamespace(GPU=GPU, CPU=CPU, ACCELERATOR=ACCELERATOR),
            CommandQueue=lambda context, chosen: ("queue", chosen.name))
        monkeypatch.setitem(sys.modules, "pyopencl", fake)
        return fake

    return install


TWO = (platform("Portable Computing Language", device("pthread-EPYC", CPU, 64)),
       platform("NVIDIA CUDA", device("NVIDIA H100"), device("NVIDIA T4", units=4)))


@pytest.mark.parametrize("name, chosen", [
    (None, "NVIDIA H100"), ("auto", "NVIDIA H100"), ("t4", "NVIDIA T4"), ("cpu", "pthread-EPYC"),
    ("GPU", "NVIDIA H100"), ("portable", "pthread-EPYC"), ("cuda / nvidia t", "NVIDIA T4")])
def test_choice_by_name(machine, name, chosen):
    machine(*TWO)
    opened = open_device(name)
    assert isinstance(opened, Device) and opened.info.name == chosen and opened.queue == ("queue", chosen)
    assert opened.has("cl_khr_fp64") and open_device(opened) is opened


def test_environment(machine, monkeypatch):
    machine(*TWO)
    monkeypatch.setenv("PAGAS_CL_DEVICE", "T4")
    assert open_device().info.name == "NVIDIA T4"
    assert open_device("H100").info.name == "NVIDIA H100"
    monkeypatch.setenv("PAGAS_CL_DEVICE", "tesla")
    with pytest.raises(DeviceError, match="PAGAS_CL_DEVICE='tesla'"):
        open_device()


def test_no_match_lists_the_names(machine):
    machine(*TWO)
    with pytest.raises(DeviceError, match="no OpenCL device matches device='radeon'; found: Portable Computing "
                                          "Language / pthread-EPYC; NVIDIA CUDA / NVIDIA H100; NVIDIA CUDA / "
                                          "NVIDIA T4"):
        open_device("radeon")


def test_falling_back_to_the_cpu_is_said_aloud(machine, caplog):
    machine(TWO[0])
    with caplog.at_level(logging.WARNING, "pagas_cl"):
        assert open_device().info.kind == "CPU"
        assert "no graphics card (GPU) was found" in caplog.text
        caplog.clear()
        open_device("cpu")  # requested: nothing to warn of
        assert not caplog.text


@pytest.mark.parametrize("fault, word", [
    ({"available": 0}, "not available"), ({"compiler_available": 0}, "a compiler"),
    ({"endian_little": 0}, "byte order"),
    ({"opencl_c_version": "OpenCL C 1.1 x"}, "OpenCL C 1.2"), ({"local_mem_size": 1024}, "local memory"),
    ({"max_work_group_size": 1}, "work-groups")])
def test_an_unusable_device_is_passed_over_or_named(machine, fault, word):
    machine(platform("P", device("broken", units=99, **fault), device("good", units=1)))
    assert open_device().info.name == "good"
    with pytest.raises(DeviceError, match=f"P / broken lacks .*{word}"):
        open_device("broken")


def test_no_platform_says_where_it_looked_and_what_to_install(machine, monkeypatch, tmp_path):
    (tmp_path / "broken.icd").write_text("libnothing.so\n")
    monkeypatch.setenv("OCL_ICD_VENDORS", str(tmp_path))
    monkeypatch.setattr(vendors, "loader_complaints", lambda: ["libnothing.so: cannot open shared object file"])

    def none():
        raise ClError("PLATFORM_NOT_FOUND_KHR")

    for how in ({"get_platforms": none}, {}):
        machine(**how)
        with pytest.raises(DeviceError) as caught:
            open_device()
        for part in ("no OpenCL platform found", str(tmp_path), "broken.icd", "OCL_ICD_VENDORS", "libnothing.so",
                      'pip install "pagas-cl[cpu]"'):
            assert part in str(caught.value)


@pytest.mark.parametrize("system, way", [("win32", "OCL_ICD_FILENAMES"), ("darwin", "conda-forge")])
def test_what_other_systems_have_is_not_looked_for_where_linux_has_it(monkeypatch, system, way):
    monkeypatch.setattr(sys, "platform", system)
    monkeypatch.setattr(vendors, "_intel_files", list)       # pip has installed it, without what Linux has of it
    assert way in vendors.no_platform() and "/etc/OpenCL" not in vendors.no_platform()
    assert "/dev/kfd" not in vendors.no_device(["AMD Accelerated Parallel Processing"])
    assert not vendors.intel_is_incomplete()


def test_nvidia_library_without_its_icd_file(monkeypatch, tmp_path):
    monkeypatch.setenv("OCL_ICD_VENDORS", str(tmp_path / "none"))
    monkeypatch.setattr(vendors, "_nvidia_library", lambda: "/usr/lib/x/libnvidia-opencl.so.1")
    monkeypatch.setattr(vendors, "icd_files", lambda: [])
    assert "echo libnvidia-opencl.so.1 > /etc/OpenCL/vendors/nvidia.icd" in vendors.no_platform()


def test_platform_without_devices(machine, monkeypatch):
    monkeypatch.delenv("POCL_DEVICES", raising=False)
    machine(platform("AMD Accelerated Parallel Processing"))
    with pytest.raises(DeviceError, match="have no device: AMD .*render and video"):
        open_device()


def test_a_platform_that_fails_does_not_hide_the_others(machine):
    def fails():
        raise ClError("DEVICE_NOT_FOUND")

    fake = machine(SimpleNamespace(name="bad", get_devices=fails), *TWO)
    assert len(find_devices(fake)) == 3


def test_a_device_that_fails_is_passed_over_or_named(machine, caplog):
    machine(*TWO, faults={"NVIDIA H100": "with 1 lane its compiler fails (no such target)"})
    assert open_device().info.name == "NVIDIA T4"
    assert "NVIDIA H100" in caplog.text and "not used: with 1 lane its compiler fails" in caplog.text
    with pytest.raises(DeviceError, match="NVIDIA H100.*no such target.*driver older"):
        open_device("h100")


def test_of_two_drivers_for_a_processor_the_faster_one_is_taken(machine):
    old, new = (platform("Portable Computing Language", device(name, CPU, 2, driver_version=version))
                for name, version in (("old", "3.0-rc2"), ("new", "3.1+debian")))
    machine(old, new)
    assert open_device().info.name == "new"
    machine(old, new, platform("Intel(R) OpenCL", device("intel", CPU, 2)))
    assert open_device().info.name == "intel"


def test_a_context_that_cannot_be_made(machine):
    def fails(devices):
        raise ClError("OUT_OF_RESOURCES")

    machine(*TWO, Context=fails)
    with pytest.raises(DeviceError, match="NVIDIA H100.*: OUT_OF_RESOURCES.*NVIDIA T4.*: OUT_OF_RESOURCES"):
        open_device("nvidia")


def test_pyopencl_that_cannot_be_loaded(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyopencl", None)
    with pytest.raises(DeviceError, match="pip install pyopencl"):
        open_device()
    assert "--force-reinstall" in vendors.no_pyopencl(ImportError("DLL load failed"))


def test_extensions_can_be_taken_for_absent(machine, monkeypatch):
    monkeypatch.setenv("PAGAS_CL_WITHOUT", "cl_khr_int64_base_atomics, cl_khr_fp64")
    machine(*TWO)
    assert not open_device().info.extensions


def test_does_without():
    assert DeviceInfo("P", "D", "GPU").does_without and not DeviceInfo(
        "P", "D", "GPU", extensions=("cl_khr_fp64", "cl_khr_int64_base_atomics")).does_without


@pytest.mark.parametrize("program, fault", [
    ("import os; os.abort()", "crashed (SIGABRT: no message)"),
    ("import sys; sys.exit('LLVM ERROR: no')", "ended with status 1 (LLVM ERROR: no)"),
    ("print('no JSON')", "ended with status 0 (no message)"),
    (r"import os; os.write(2, b'error: \xb5\n'); os._exit(3)", "ended with status 3 (error: \ufffd)"),
    ("import time; time.sleep(60)", "gave no answer within 2 s")])
def test_a_child_that_gives_no_answer(tmp_path, monkeypatch, program, fault):
    (tmp_path / "driver_of_the_test.py").write_text(program)
    monkeypatch.syspath_prepend(str(tmp_path))
    answer = ask("driver_of_the_test", {}, 2.0)
    assert answer.value is None and answer.fault == fault and answer.hung == ("no answer" in fault)
    assert answer.crashed == ("SIGABRT" in fault or "status 3" in fault)      # which abort() has on Windows


def test_a_driver_may_write_in_any_encoding(tmp_path, monkeypatch):
    (tmp_path / "driver_of_the_test.py").write_text(
        "import os; from pagas_cl.system.child import answer; os.write(1, b'50\\xb5s\\n'); answer(dict)")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert ask("driver_of_the_test", {"works": True}, 60.0).value == {"works": True}


def test_the_real_machine():
    """Needs an OpenCL device; `make test` installs PoCL, so there is one."""
    devices = [info for info, _ in find_devices(import_pyopencl())]
    opened = open_device("auto")
    # a virtual machine's memory may grow meanwhile
    lasting = [replace(info, memory=0, max_alloc=0) for info in (opened.info, *devices)]
    assert lasting[0] in lasting[1:] and opened.queue.context == opened.context
