"""Choosing a device, with a pyopencl that is made of plain objects, and once with the real one."""

import json
import logging
import subprocess
import sys
from types import SimpleNamespace

import pytest

from pagas_cl.errors import DeviceError
from pagas_cl.runtime import icd, listing
from pagas_cl.runtime.device import Device, DeviceInfo, find_devices, open_device

GPU, CPU, ACCELERATOR = 4, 2, 8


class ClError(Exception):
    """Stands for pyopencl.Error."""


def device(name, kind=GPU, units=10, **more):
    return SimpleNamespace(**{
        "name": name, "type": kind, "vendor": "vendor ", "version": "OpenCL 3.0 ", "driver_version": "1.2.3",
        "opencl_c_version": "OpenCL C 1.2 ", "global_mem_size": 2**33, "max_mem_alloc_size": 2**31,
        "local_mem_size": 48 * 1024, "max_work_group_size": 1024, "max_compute_units": units,
        "extensions": "cl_khr_fp64 cl_khr_int64_base_atomics", "available": 1, "compiler_available": 1,
        "endian_little": 1, **more})


def platform(name, *devices):
    return SimpleNamespace(name=name, get_devices=lambda: list(devices))


@pytest.fixture
def machine(monkeypatch):
    """A function that puts platforms into a mocked pyopencl."""
    monkeypatch.delenv("PAGAS_CL_DEVICE", raising=False)
    monkeypatch.setattr("pagas_cl.runtime.device._told", set())

    def install(*platforms, get_platforms=None, Context=lambda devices: devices[0], build=lambda context: None):
        fake = SimpleNamespace(
            Error=ClError, Context=Context, get_platforms=get_platforms or (lambda: list(platforms)),
            device_type=SimpleNamespace(GPU=GPU, CPU=CPU, ACCELERATOR=ACCELERATOR),
            command_queue_properties=SimpleNamespace(PROFILING_ENABLE=2),
            CommandQueue=lambda context, chosen, properties: ("queue", chosen.name, properties),
            Program=lambda context, source: SimpleNamespace(build=lambda options: build(context)))
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
    assert isinstance(opened, Device) and opened.info.name == chosen and opened.queue == ("queue", chosen, 0)
    assert opened.has("cl_khr_fp64") and open_device(opened) is opened


def test_profiling_and_environment(machine, monkeypatch):
    machine(*TWO)
    monkeypatch.setenv("PAGAS_CL_DEVICE", "T4")
    assert open_device().info.name == "NVIDIA T4"
    assert open_device("H100", profiling=True).queue == ("queue", "NVIDIA H100", 2)
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
        assert "no usable OpenCL GPU" in caplog.text
        caplog.clear()
        open_device("cpu")  # asked for: nothing to warn of
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
    monkeypatch.setattr(icd, "loader_complaints", lambda: ["libnothing.so: cannot open shared object file"])

    def none():
        raise ClError("PLATFORM_NOT_FOUND_KHR")

    for how in ({"get_platforms": none}, {}):
        machine(**how)
        with pytest.raises(DeviceError) as caught:
            open_device()
        for words in ("no OpenCL platform found", str(tmp_path), "broken.icd", "OCL_ICD_VENDORS", "libnothing.so",
                      'pip install "pagas-cl[pocl]"'):
            assert words in str(caught.value)


def test_nvidia_library_without_its_icd_file(monkeypatch, tmp_path):
    monkeypatch.setenv("OCL_ICD_VENDORS", str(tmp_path / "none"))
    monkeypatch.setattr(icd, "_nvidia_library", lambda: "/usr/lib/x/libnvidia-opencl.so.1")
    monkeypatch.setattr(icd, "icd_files", lambda: [])
    assert "echo libnvidia-opencl.so.1 > /etc/OpenCL/vendors/nvidia.icd" in icd.no_platform()


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
    def fails(context):
        if "H100" in context.name:
            raise ClError("build failed\nerror: no such target")

    machine(*TWO, build=fails)
    assert open_device().info.name == "NVIDIA T4"
    assert "NVIDIA H100" in caplog.text and "passed over: error: no such target" in caplog.text
    with pytest.raises(DeviceError, match="NVIDIA H100.*error: no such target.*driver older"):
        open_device("h100")


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
    assert "--force-reinstall" in icd.no_pyopencl(ImportError("DLL load failed"))


def test_the_listing_tries_every_device(machine):
    def fails(context):
        if "H100" in context.name:
            raise ClError("error: no such target")

    machine(*TWO, build=fails)
    told = {d["name"]: DeviceInfo(**d) for d in json.loads(listing._answer())["devices"]}
    assert "compiler that works (error: no such target)" in told["NVIDIA H100"].lacks[0]
    assert not told["NVIDIA T4"].lacks


def test_does_without():
    assert DeviceInfo("P", "D", "GPU").does_without and not DeviceInfo(
        "P", "D", "GPU", extensions=("cl_khr_fp64", "cl_khr_int64_base_atomics")).does_without


@pytest.mark.parametrize("child, words", [
    (SimpleNamespace(returncode=-11, stdout="", stderr=""), "crashed while .*SIGSEGV"),
    (SimpleNamespace(returncode=1, stdout="", stderr="a\nImportError: b"), "cannot be listed: ImportError: b"),
    (SimpleNamespace(returncode=0, stdout='noise\n{"error": "no OpenCL platform"}\n', stderr=""),
     "no OpenCL platform")])
def test_listing_survives_a_bad_driver(monkeypatch, child, words):
    monkeypatch.setattr(subprocess, "run", lambda *a, **k: child)
    with pytest.raises(DeviceError, match=words):
        listing.list_devices()


def test_listing_tells_of_a_driver_that_hangs(monkeypatch):
    def hangs(*a, timeout, **k):
        raise subprocess.TimeoutExpired("x", timeout)

    monkeypatch.setattr(subprocess, "run", hangs)
    with pytest.raises(DeviceError, match="did not answer within"):
        listing.list_devices()


def test_the_real_machine():
    """Needs an OpenCL device; `make test` installs PoCL, so there is one."""
    devices = listing.list_devices()
    opened = open_device("auto")
    assert opened.info in devices and opened.queue.context == opened.context
