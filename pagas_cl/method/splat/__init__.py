"""The splatting on the device, one module a kernel file (method sections 3 to 6)."""

from pagas_cl.method.splat.inputs import ViewInput
from pagas_cl.method.splat.photos import PhotoStore, reading_ahead
from pagas_cl.method.splat.view import (
    Refinement,
    better_start,
    explained_by,
    hypotheses_for,
    probe_view,
    refine_levels,
    relit_views,
    resolve_edges,
)

__all__ = ["PhotoStore", "Refinement", "ViewInput", "better_start", "explained_by", "hypotheses_for", "probe_view",
           "reading_ahead", "refine_levels", "relit_views", "resolve_edges"]
