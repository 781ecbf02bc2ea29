"""A small scene as `tradeoff` judges it."""

from functools import cache

from support.scenes import relief_scene

from pagas_cl.app.tradeoffs.case import make_cases


def made_scene():
    """96 x 72 pixels, 6 context views, 1 held out."""
    return relief_scene(96, 72, 6, held_out=1)


@cache
def judged_case():
    """Its target, judged by the truth and by the held-out view."""
    made = made_scene()
    views = made.all_views
    return make_cases(views, [made.initial_depth(v.camera) for v in views], names=[views[0].name],
                      truth=[made.true_depth(v.camera) for v in views], held_out=[made.held_out[0].name])[0]
