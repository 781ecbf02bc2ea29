"""An effect that is off adds nothing: the program is that of a source which never had it,
and no buffer is made for it."""

from __future__ import annotations

import re
import shutil
import subprocess
from types import SimpleNamespace

import pytest
from support.effects import ALL_ON, COMPILED, all_but
from support.stripped import STEP, never_had, parameters_in, parameters_of, without_blocks

from pagas_cl.config.presets import BALANCED

pytest.importorskip("pyopencl")


def tokens(source: str, config) -> list[str]:
    """What the compiler sees of `source`, by the system's C preprocessor."""
    from pagas_cl.method.splat.options import SCALAR, defines

    device = SimpleNamespace(has=lambda extension: True)
    options = [f"-D{define}" for define in (*defines(config, device, 300), *SCALAR[0].defines)]
    seen = subprocess.run([shutil.which("cpp"), "-P", "-undef", "-nostdinc", *options], input=source,
                          capture_output=True, text=True, check=True).stdout
    return re.findall(r"\w+|[^\w\s]", seen)


@pytest.mark.parametrize("file", STEP)
@pytest.mark.parametrize("effect", COMPILED)
def test_the_program_is_that_of_a_source_without_the_effect(effect, file):
    """Token for token, but for parameters that nothing reads."""
    from pagas_cl.runtime.program import source

    if not shutil.which("cpp"):
        pytest.skip("there is no C preprocessor")
    text, config = source(file), all_but(effect)
    macros, parameters = COMPILED[effect].macros, parameters_in(effect, file)
    bare = without_blocks(text, macros)
    assert not [line for line in bare.splitlines()
                if re.match(rf"\s*#.*\b({'|'.join(macros)})\b", line.partition("//")[0])]
    assert tokens(text, config) == tokens(bare, config)
    without = tokens(never_had(effect, file, text), config)
    assert not set(parameters) & set(without)
    of_parameters = {*parameters, "__global", "const", "float", "uint", "int", "*", ","}
    have, lack = ([token for token in found if token not in of_parameters] for found in (tokens(text, config), without))
    assert have == lack


@pytest.mark.parametrize("effect", COMPILED)
def test_switched_on_it_is_another_program(effect):
    """Else the test above would say nothing."""
    from pagas_cl.runtime.program import source

    if not shutil.which("cpp"):
        pytest.skip("there is no C preprocessor")
    on = BALANCED.with_settings(**ALL_ON)
    assert any(tokens(source(file), on) != tokens(source(file), all_but(effect)) for file in STEP)


def names_of_buffers(config) -> set[str]:
    from pagas_cl.method.splat.buffers import LevelBuffers, dimensions
    from pagas_cl.scene.camera import Size

    sizes = [Size(80, 60)] * 3
    return {spec.name for spec in LevelBuffers.plan(dimensions(config, sizes[0], sizes[1:], 2))}


@pytest.mark.parametrize("effect", COMPILED)
def test_no_buffer_is_made_for_it(effect):
    buffers = set(COMPILED[effect].buffers)
    with_it, without = names_of_buffers(BALANCED.with_settings(**ALL_ON)), names_of_buffers(all_but(effect))
    assert with_it - without == buffers


def test_no_buffer_is_made_for_smoothness_that_is_off():
    off = BALANCED.with_settings(smoothness__kind="none")
    assert names_of_buffers(BALANCED) - names_of_buffers(off) == {"kappa", "weights"}


def test_stripping():
    text = "a\n#ifdef X\nb\n#ifdef Y\nc\n#endif\n#else\nd\n#endif\n#ifdef Y\ne\n#endif"
    assert without_blocks(text, ("X",)).split() == "a d #ifdef Y e #endif".split()
    assert without_blocks(text, ("Y",)).split() == "a #ifdef X b #else d #endif".split()
    kernel = ("__kernel void f(__global const float *low_pass, int a, float low_pass2,\n"
              "  float relative) { g(low_pass, a, relative); }")
    assert parameters_of(kernel, "f") == ["low_pass", "a", "low_pass2", "relative"]
