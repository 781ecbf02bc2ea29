"""What a kernel may be given: whole numbers of 32 bits, or a sentence that says which one is not; and that a kernel
which is used again has the arguments of now."""

import re

import numpy as np
import pytest

from pagas_cl.config.presets import BALANCED
from pagas_cl.errors import DeviceError
from pagas_cl.method.splat.constants import SHARED
from pagas_cl.method.splat.options import defines
from pagas_cl.runtime.program import COMMON, bind, build, run_once, signatures, source

pytestmark = pytest.mark.kernels


def rate_falls(device, patience):
    """Whether the schedule of step.cl lowers the rate after one step without a better loss."""
    import pyopencl as cl

    arrays = np.array([1, 0, 0, 0, 5, 0, 0, 0], np.float32), np.zeros(1, np.int64), np.zeros(4, np.float32)
    buffers = [device.buffer(array.nbytes) for array in arrays]
    for buffer, array in zip(buffers, arrays):
        cl.enqueue_copy(device.queue, buffer, array)
    run_once(device.queue, [bind(build(device, "step.cl", SHARED), "plateau", (1,), state=buffers[0],
                                photo_loss=buffers[1], history=buffers[2], number=1, patience=patience,
                                floor_rate=0.0)])
    cl.enqueue_copy(device.queue, arrays[0], buffers[0])
    return arrays[0][0] < 1


def test_what_is_compiled_together_is_the_same_for_any_settings(device):
    """Else it would be compiled anew, all of it, for each."""
    other = BALANCED.with_settings(splatting__blend="alpha", splatting__occlusion=False, solver__gradient_filter=0)
    for config in (BALANCED, other):
        assert build(device, "step.cl", defines(config, device, 64)) is build(device, "units.cl", SHARED)
    assert build(device, "agree.cl", SHARED) is not build(device, "units.cl", SHARED)
    files = re.split(r"#line 1 .*", source(COMMON))
    macros = [name for text in files for name in set(re.findall(r"#define (\w+)", text))]
    assert len(set(macros)) == len(macros), "a compiler may refuse what is defined twice"


@pytest.mark.parametrize("kind", [int, np.int32, np.int64, np.uint32])
def test_whole_numbers_of_any_kind_arrive(device, kind):
    assert rate_falls(device, kind(1)) and not rate_falls(device, kind(2)) and not rate_falls(device, kind(2**31 - 1))


def test_the_least_number_arrives(device):
    assert rate_falls(device, -2**31)


@pytest.mark.parametrize("number", [2**31, -2**31 - 1, 2**32 + 1, 10**30, np.int64(2**31), np.uint32(2**31)])
def test_a_number_that_does_not_fit_is_refused(device, number):
    with pytest.raises(DeviceError, match=rf"kernel plateau was given {number}, expected a whole number of 32 bits"):
        rate_falls(device, number)
    assert rate_falls(device, 1), "the kernel is usable afterwards"


def test_a_kernel_that_is_used_again_has_the_arguments_of_now(device):
    """Buffers that come and go at the same addresses, numbers changed behind bind's back."""
    import pyopencl as cl

    program, source = build(device, "step.cl", SHARED), np.full(4, 5, np.float32)
    for repeat in range(6):
        state, loss, history = (
            device.buffer(nbytes) if repeat < 4 else
            cl.Buffer(device.context, cl.mem_flags.READ_WRITE, nbytes) for nbytes in (32, 8, source.nbytes))
        cl.enqueue_copy(device.queue, state, np.array([1, 0, 0, 0, 2, 0, 0, 0], np.float32))
        cl.enqueue_copy(device.queue, loss, np.array([(3 + repeat) * 2**40], np.int64))
        launch = bind(program, "plateau", (1,), state=state, photo_loss=loss, history=history, number=1,
                      patience=9, floor_rate=0.0)
        if repeat % 2:
            launch.set(number=3)                # the place in the history
        run_once(device.queue, [launch])
        found = np.zeros(4, np.float32)
        cl.enqueue_copy(device.queue, found, history)
        assert found[2 if repeat % 2 else 0] == 5 + repeat
        del launch, state, loss, history


def test_an_argument_of_another_name_or_one_too_few_is_refused(device):
    program, given = build(device, "summary.cl", SHARED), dict(rows=None, count=1, rules=None)
    with pytest.raises(TypeError, match=r"kernel summarize takes rows, count, rules, summary: missing \['summary'\]"):
        bind(program, "summarize", (64,), **given)
    with pytest.raises(TypeError, match=r"missing \[\], unknown \['sums'\]"):
        bind(program, "summarize", (64,), summary=None, sums=None, **given)


def test_signatures_are_read_from_the_source():
    text = """__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
    void f(__global const float *restrict depth,   // [H, W], units (device, not scene)
           int width, /* of the image, */ CONSTANT float *cameras, float scale) { g(depth); }"""
    assert signatures(text) == {"f": {"depth": "", "width": "int", "cameras": "", "scale": "float"}}
