"""The splatting on the device, one module a kernel file (method sections 3 to 6)."""

from pagas_cl.method.splat.photos import PhotoStore
from pagas_cl.method.splat.view import (
    NormalizedDepth,
    Refinement,
    explained_by,
    hypotheses_for,
    probe_view,
    refine_levels,
    relit_views,
)

__all__ = ["NormalizedDepth", "PhotoStore", "Refinement", "explained_by", "hypotheses_for", "probe_view",
           "refine_levels", "relit_views"]
