"""Launches of gradient_filter.cl: the gradient that a step follows, that of the photos averaged over neighbouring
pixels and that of planar smoothness (method sections 5 and 6)."""


def launches(programs, buffers, target, weight: float) -> list:
    """From buffers.gradient to buffers.followed, with N dL_s/dd of planar smoothness; nothing where neither is
    enabled."""
    if buffers.followed is None:
        return []
    s = programs.config.smoothness
    return [programs.bind("gradient_filter.cl", "filter_gradient", target.size, buffers, target, scale=weight,
                          h=s.huber, discontinuity=s.discontinuity)]
