"""Launches of gradient_filter.cl: the gradient of the photos averaged over neighbouring pixels (method section 6)."""


def launches(programs, buffers, size) -> list:
    """Average buffers.gradient in place; once a step, before the smoothness adds to it."""
    if programs.config.solver.gradient_filter == 0:
        return []
    return [programs.bind("gradient_filter.cl", name, size.grid, buffers, **size.extent)
            for name in ("filter_across", "filter_down")]
