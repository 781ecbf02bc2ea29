"""The splatting on the device, one module a kernel file (method sections 3 to 6)."""

from pagas_cl.splat.state import PhotoStore
from pagas_cl.splat.view import Entered, Refinement, probe_view, refine_levels

__all__ = ["Entered", "PhotoStore", "Refinement", "probe_view", "refine_levels"]
