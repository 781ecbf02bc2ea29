"""Small analytic scenes for the tests, each made once a session."""

from __future__ import annotations

from functools import cache

from pagas_cl.app import synthetic


def relief_scene(width: int = 388, height: int = 290, contexts: int = 10, **settings):
    """As synthetic.relief_scene, but the same scene whenever it is asked for, with the photos that it has rendered by
    then: read-only."""
    return _made(width, height, contexts, **settings)


_made = cache(synthetic.relief_scene)


def tiny(**settings):
    """96 x 72 pixels, 3 context views, 1 held out; `settings` as in synthetic.Relief."""
    return relief_scene(**{"width": 96, "height": 72, "contexts": 3, "held_out": 1, **settings})


def small(**settings):
    """388 x 290 pixels, 5 context views, 1 held out: big enough for error figures to mean something."""
    return relief_scene(**{"width": 388, "height": 290, "contexts": 5, "held_out": 1, **settings})


def plane(**settings):
    """A tiny scene whose surface is the plane z = 0."""
    return tiny(base=0.0, detail=0.0, steps=0, **settings)
