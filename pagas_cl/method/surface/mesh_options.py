"""How a mesh is made of refined depth maps."""

from collections.abc import Callable
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Any

import numpy as np

from pagas_cl.errors import InputError, check_kind, short


@dataclass(frozen=True, eq=False)
class MeshOptions:
    """What comes of the depth maps: `output` and the numbers as in refine_mesh, None = the default; no output, no mesh.
    `memory_mb` of host memory; `note` is called with a sentence on what was found out while the mesh was made."""

    output: str | None = None
    subdivide: float | None = None
    tolerance: float | None = None
    triangles: int | None = None
    memory_mb: float | None = None
    color: bool = False
    note: Callable[[str], Any] | None = None

    def check(self) -> None:
        """InputError for what is no such number, and for numbers that contradict each other or change nothing."""
        numbers = (("subdivide", self.subdivide, 0.25, 1e6, "the longest edge in pixel footprints, 0.25 or more"),
                   ("tolerance", self.tolerance, 1e-6, 100, "a distance in pixel footprints, above 0, at most 100"),
                   ("triangles", self.triangles, 4, 2**31 - 1, "how many triangles, 4 or more"),
                   ("memory", self.memory_mb, 1e-9, 1e12, "MB of host memory, above 0, at most 1e12"))
        for name, value, least, most, expected in numbers:
            number = isinstance(value, Integral if name == "triangles" else Real) and not isinstance(value, bool)
            if value is not None and not (number and least <= value <= most):
                raise InputError(f"{name} is {short(value)}, expected None or {expected}")
        given = [name for name, value, *_ in numbers[1:3] if value is not None]
        if len(given) == 2:
            raise InputError("expected triangles or tolerance, got both: either says how many triangles are left")
        check_kind("color", self.color, (bool, np.bool_), "True or False")
        if given and self.output != "mesh":
            raise InputError(f"{given[0]} is for output='mesh', the given mesh with other triangles; got "
                             f"output={self.output!r}")
        if self.subdivide is not None and self.output == "tsdf":
            raise InputError("subdivide is for output='mesh' or 'displace', which split the given mesh; got "
                             "output='tsdf', a new mesh that has the voxel's fineness: set fusion.voxel")


NO_MESH = MeshOptions()
