"""Launches of carry_over.cl: what a smaller size has found, carried over to another (method sections 6, 8.3)."""

from dataclasses import dataclass

import pyopencl as cl

from pagas_cl.method.splat.constants import SHARED
from pagas_cl.runtime.device import Device
from pagas_cl.runtime.memory import release
from pagas_cl.runtime.program import Program, build
from pagas_cl.scene.camera import Size

LEFT_BYTES = 12         # a pixel of the smaller size, of Followed,
NBYTES = 32             # and in all while that is found, with the depth that was given there


@dataclass(frozen=True)
class Followed:
    """By which share of its depth each pixel of a smaller `size` is to move, and of which surface it is."""

    moves: cl.Buffer
    size: Size

    def carry_over(self, device: Device, depth: cl.Buffer, size: Size) -> None:
        """Move `depth`, of another `size`, along; once."""
        _program(device).run("carry_over", size, followed=self.moves, small_width=self.size.width,
                             small_height=self.size.height, depth=depth, **size.extent)
        release(self.moves)


def follow(device: Device, size: Size, scale: float, given: cl.Buffer, depth: cl.Buffer, parallax: cl.Buffer,
           deviation: cl.Buffer | None = None) -> Followed:
    """How the pixels of a smaller `size` have moved from the `given` depth to `depth`: what is unsure as those around
    it; not all the way by less than a pixel of parallax at full size, of which `scale` is the share (0: always)."""
    program = _program(device)
    moves, followed = (device.buffer(4 * numbers * size.pixels) for numbers in (4, 3))
    program.run("find_moves", (size.pixels,), count=size.pixels, given=given, depth=depth, parallax=parallax,
                deviation=deviation, moves=moves)
    program.run("follow_sure", size, moves=moves, scale=scale, followed=followed, **size.extent)
    release(moves)
    return Followed(followed, size)


def _program(device: Device) -> Program:
    return build(device, "carry_over.cl", SHARED)
