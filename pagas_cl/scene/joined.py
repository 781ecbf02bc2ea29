"""Which result belongs to which view."""

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from pagas_cl.errors import InputError
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.view import View


class Named(Protocol):
    """A result of a view: what a view and it have in common."""

    @property
    def name(self) -> str:
        """The view's."""

    @property
    def camera(self) -> Camera:
        """The view's, or one that was refined with it."""


def joined(views: Sequence[View], results: Sequence[Named]) -> list[tuple[int, Any]]:
    """(place in `views`, result) for each result that is of one of the views, in the order of the results.

    By the view's name; where several views have it, by the camera too. InputError where that leaves a choice.
    """
    called: dict[str, list[int]] = {}
    for place, view in enumerate(views):
        called.setdefault(view.name, []).append(place)
    found: dict[int, Any] = {}
    for result in results:
        places = called.get(result.name, [])
        if len(places) > 1:
            places = ([p for p in places if views[p].camera is result.camera]
                      or [p for p in places if _same(views[p].camera, result.camera)])
        if len(places) > 1:
            raise InputError(f"{len(places)} views are called {result.name!r} and have the same camera, expected a "
                             "name for each, by which its result is found")
        if places and found.setdefault(places[0], result) is not result:
            raise InputError(f"there are two results of view {result.name!r}, expected one")
    return list(found.items())


def _same(one: Camera, other: Camera) -> bool:
    """Whether two cameras are the same in all their numbers."""
    return ((one.width, one.height) == (other.width, other.height) and np.array_equal(one.K, other.K)
            and np.array_equal(one.world_to_camera, other.world_to_camera))
