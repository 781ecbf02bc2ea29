"""From the small photos that a network saw, and that its cameras belong to, to the original photos."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from pagas_cl.errors import InputError, log
from pagas_cl.scene.images import image_size
from pagas_cl.scene.placement import find_placement
from pagas_cl.scene.readers import photos as photo_files
from pagas_cl.scene.view import View


def with_originals(views: Sequence[View], folder: Path) -> list[View]:
    """The views with their photos out of `folder`, by name or stem, and cameras to match.

    How each photo became the small one (stretched, padded, cropped) is found by comparing them. InputError where a
    photo is missing, shows something else, or a view has a mask, which belongs to the small photo.
    """
    if not folder.is_dir():
        raise InputError(f"photos: {folder} is no folder")
    found = photo_files.list_photos(folder)
    names = {path.name: path for path in found}
    stems = {path.stem: path for path in found}
    result, kinds = [], set()
    for view in views:
        photo = names.get(Path(view.name).name) or stems.get(view.stem)
        if photo is None:
            raise InputError(f"photos: {folder} holds no photo called {Path(view.name).name}, of the {len(views)} that "
                             "the cameras belong to")
        if view.mask is not None:
            raise InputError(f"view {view.name!r} has a mask of its small photo; put masks beside the originals, or "
                             "leave them out")
        small = view.camera.width, view.camera.height
        placement = find_placement(photo, small, view.load_image(), f"photo {photo}")
        kinds.add(placement.kind)
        camera = placement.photo_camera(view.camera, *image_size(photo))
        result.append(View(replace(camera, name=view.name), photo, None, view.name))
    log.info("cameras belong to photos of %d x %d (%s); they are scaled to those in %s, %d x %d", views[0].camera.width,
             views[0].camera.height, " and ".join(sorted(kinds)), folder, result[0].camera.width,
             result[0].camera.height)
    return result
