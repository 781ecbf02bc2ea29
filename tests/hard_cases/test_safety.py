"""Kernels stay within what every OpenCL 1.2 device has, read nothing that was not written, and do not depend on how
work is grouped."""

from __future__ import annotations

import itertools
import re
import subprocess
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pyopencl as cl
import pytest
from oclgrind import command
from support import hard_scenes as make
from support.hard_check import device_gradient, normalized
from support.hard_table import BLENDS

from pagas_cl.method.cameras import adjust, normalize
from pagas_cl.method.splat import hypotheses, measure, options
from pagas_cl.method.surface import agreement, mesh_evidence, mesh_solve
from pagas_cl.runtime import arena, program

KERNELS = Path(program.files("pagas_cl.cl_kernels").joinpath("loss.cl")).parent
FILES = sorted(path.name for path in KERNELS.glob("*.cl"))
VARIANTS = {
    "order-free": {}, "alpha": {}, "alpha wide": dict(splatting__radius=5.0),
    "grey": dict(loss__grey=True, loss__robust=0.5, loss__structure=True, loss__exposure=True),
}
TILE_OF = {"ssim.cl": options.SCALAR[0], "loss.cl": options.SCALAR[1], "gradient_filter.cl": options.FILTERED}
# of a file alone, in addition to those of the settings
MORE = {"measure.cl": measure._ROW_NUMBERS, "agreement.cl": agreement.OWN_DEFINES,
        "hypotheses.cl": hypotheses.OWN_DEFINES, "edges.cl": hypotheses.OWN_DEFINES}
OWN = {"adjust.cl": adjust.DEFINES, "normalize.cl": normalize.DEFINES, "mesh_evidence.cl": mesh_evidence.DEFINES,
       "mesh_solve.cl": mesh_solve.DEFINES}        # no others
NEWER = r"\bdouble|\bhalf\b|atomic_fetch|work_group_(?:all|any|reduce|scan|broadcast|barrier)|generic\b"
NO_DOUBLE = "#pragma OPENCL EXTENSION cl_khr_fp64 : disable\n"


def variant(name: str):
    return BLENDS["alpha" if name.startswith("alpha") else "order-free"].with_settings(**VARIANTS[name])


ORDER_FREE_ONLY = ("composite.cl",)       # never built with the alpha blend


@cache
def kernels_of(device, file, defines) -> list:
    """Of each kernel its name, bytes of local memory, and work-items of a group."""
    built = cl.Program(device.context, NO_DOUBLE + program.source(file)).build(
        [*program.OPTIONS, *(f"-D{define}" for define in defines)])
    return [(kernel.function_name, *(np.prod(kernel.get_work_group_info(what, device.cl_device)) for what in (
        cl.kernel_work_group_info.LOCAL_MEM_SIZE, cl.kernel_work_group_info.COMPILE_WORK_GROUP_SIZE)))
            for kernel in built.all_kernels()]


@pytest.mark.filterwarnings("ignore:Non-empty compiler output")       # Intel's compiler reports that it is done
@pytest.mark.parametrize("file, name", [(file, name) for file, name in itertools.product(FILES, VARIANTS)
                                        if not (file in ORDER_FREE_ONLY and name.startswith("alpha"))
                                        and not (file in OWN and name != "grey")])
def test_kernels_fit_any_device_of_opencl_1_2(device, file, name):
    """Without double precision, within 32 kB of local memory and 256 work-items."""
    given = options.defines(variant(name).with_settings(solver__gradient_filter=16), device, 64) + MORE.get(file, ())
    given = OWN.get(file, given)
    tile = TILE_OF.get(file, options.FILTERED).defines
    for name, local, group in kernels_of(device, file, program._mentioned(file, (*given, *tile))):
        assert local <= 32 << 10, f"{name}: {local} bytes of local memory"
        assert group <= 256, f"{name}: a work-group of {group}"


@pytest.mark.kernels
def test_no_double_and_no_newer_language():
    assert "-cl-std=CL1.2" in program.OPTIONS
    for path in KERNELS.glob("*.cl*"):
        code = re.sub(r"//.*", "", path.read_text())
        assert not re.search(NEWER, code), path.name


def gradients(device, config, size=(97, 51)):
    scene = make.base(3, size=size)
    initial, scene_scale = normalized(scene)
    got, loss, _ = device_gradient(scene, config, device, initial, initial, scene_scale)
    return got.tobytes(), loss


@pytest.mark.slow
@pytest.mark.kernels
@pytest.mark.parametrize("blend", BLENDS)
def test_work_group_sizes_agree(device, blend, monkeypatch):
    """Tiles of 1, 32 and 256 work-items, bit for bit."""
    found = set()
    for group in (1, 32, 256):
        tiles = tuple(replace(part, group=group) for part in options.SCALAR)
        monkeypatch.setattr(options, "choose_tiles", lambda *_, tiles=tiles: tiles)
        found.add(gradients(device, BLENDS[blend]))
    assert len(found) == 1


@pytest.mark.kernels
@pytest.mark.parametrize("name", VARIANTS)
def test_nothing_is_read_before_it_is_written(device, name, monkeypatch):
    """Buffers that start as NaN, as ones, and as zeros give the same bits."""
    config, found, plain = variant(name).with_settings(loss__exposure=False), set(), arena.allocate

    for pattern in (0, 0xFFFFFFFF, 0x3F800000):
        def poisoned(on, specs, pattern=pattern):
            made = plain(on, specs)
            for spec in specs:
                cl.enqueue_fill_buffer(on.queue, made[spec.name], np.uint32(pattern), 0, spec.nbytes // 4 * 4)
            return made

        monkeypatch.setattr(arena, "allocate", poisoned)
        found.add(gradients(device, config, (45, 37)))
    assert len(found) == 1


@pytest.mark.slow
def test_under_oclgrind():
    """No invalid access and no data race in any kernel."""
    run = command()
    if not run:
        pytest.skip("oclgrind is not installed (Debian and Ubuntu: apt-get install oclgrind)")
    done = subprocess.run(run, capture_output=True, text=True, timeout=400)
    output = done.stdout + done.stderr
    assert done.returncode == 0, output[-2000:]
    errors = re.findall(r"^(?:Invalid|Unaligned|Uninitialized|.*data race).*$|.*errors generated.*", output, re.M)
    assert not errors, output[:3000]
    run_there = set(re.search(r"^kernels: (.*)$", output, re.M)[1].split())
    every = {name for file in FILES for name in re.findall(r"\b(\w+)\(__global", (KERNELS / file).read_text())
             if re.search(rf"__kernel[^;{{]*?\b{name}\(__global", (KERNELS / file).read_text())}
    assert every <= run_there, f"not run: {every - run_there}"
