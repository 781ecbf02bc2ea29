"""Launches of gradient_filter.cl: the photos' gradient, averaged, with planar smoothness (method sections 5 and 6)."""


def launches(programs, buffers, target, weight: float) -> list:
    """From buffers.gradient to buffers.followed, with N dL_s/dd of planar smoothness; nothing where neither is on."""
    if buffers.followed is None:
        return []
    s = programs.config.smoothness
    return [programs.bind("gradient_filter.cl", "filter_gradient", target.size, buffers, target, scale=weight,
                          h=s.huber, discontinuity=s.discontinuity)]
