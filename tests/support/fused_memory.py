"""Peak of host memory while fusing, in a process of its own: `fused_memory.py FOLDER [MB]` prints one line of JSON.

FOLDER has views.pickle (views, depths as paths); without MB the whole grid is made. The mesh goes to FOLDER/<MB>.npz.
"""

import json
import pickle
import sys
from pathlib import Path

import numpy as np

from pagas_cl.config import Fusion
from pagas_cl.method.surface.blocks import fuse_within
from pagas_cl.method.surface.fuse import fuse, fusion_plan
from pagas_cl.method.surface.grid import grid_shift


def kib(name: str) -> int:
    """A figure of /proc/self/status, KiB."""
    return next(int(line.split()[1]) for line in Path("/proc/self/status").read_text().splitlines()
                if line.startswith(name + ":"))


def main():
    folder, allowed = Path(sys.argv[1]), float(sys.argv[2]) if len(sys.argv) > 2 else None
    views, depths = pickle.loads((folder / "views.pickle").read_bytes())
    settings = Fusion(voxel=1.0, truncation=6.0, min_component=0.01)
    grid_shift()  # loads Open3D
    before = kib("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")
    if allowed is None:
        planned = fusion_plan(views, depths, settings).memory_mb
        mesh = fuse(views, depths, settings)
    else:
        planned, mesh = allowed, fuse_within(views, depths, settings, allowed)
    peak = (kib("VmHWM") - before) * 1024 / 1e6
    np.savez(folder / f"{allowed}.npz", vertices=mesh.vertices, faces=mesh.faces, normals=mesh.normals,
             colors=mesh.colors)
    sys.stdout.write(json.dumps({"planned_mb": planned, "peak_mb": peak, "vertices": len(mesh.vertices)}) + "\n")


if __name__ == "__main__":
    main()
