"""What commands do before the work: try the places they write to, read the scene and the initial depth of its views."""

from __future__ import annotations

import logging
import tempfile
from pathlib import Path

from pagas_cl.errors import InputError

log = logging.getLogger("pagas_cl")


def check_source(mesh, other, what: str, option: str = "--depth-dir") -> None:
    """Raise InputError unless exactly one of both is given; `what` says in the message what they are for."""
    if (mesh is None) == (other is None):
        raise InputError(f"expected either --mesh or {option} ({what}), got {'neither' if mesh is None else 'both'}")


def check_writable(option: str, folder: Path | None) -> None:
    """Raise InputError where no file can be made in `folder`, which need not exist: it is not made by this."""
    if folder is None:
        return
    folder = folder.absolute()
    new = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        file = next((path for path in (folder, *folder.parents) if path.is_file()), None)
        why = f"{str(file)!r} is a file" if file else error.strerror or str(error)
        raise InputError(f"{option}: cannot write in the folder {str(folder)!r} ({why}): choose another one"
                         + ("" if file else ", or see to its permissions")) from error
    finally:
        for path in new:
            if path.is_dir():
                path.rmdir()


def load_scene(scene, format, outside: bool):
    """The scene in a folder; `outside` is only passed to readers that know it, which is their error to tell."""
    from pagas_cl.scene.readers import read_scene

    return read_scene(scene, format, **({"outside": True} if outside else {}))


def initial_depths(found, mesh, depth_dir, depth_scale, progress, folder=None, names=None, device=None) -> list:
    """Initial depth of every view, from the mesh (drawn on `device`) or from files; None for a view without a file, which `names` must
    have. With a folder for the run they stay on disk, and what stands for them is given instead."""
    from pagas_cl.jobs.finished import work_folder
    from pagas_cl.jobs.store import DepthFile, Store

    if mesh is not None:
        from pagas_cl import refine
        from pagas_cl.scene.mesh import to_surface

        keep = None if folder is None else Store(work_folder(folder.resolve()) / "inputs").put
        return refine.initial_depths(to_surface(mesh), found.views, progress, keep, device)
    from pagas_cl.scene.depthmap import find_depth

    files = [find_depth(depth_dir, view.name) for view in found.views]
    if not any(files):
        raise InputError(f"--depth-dir {str(depth_dir)!r} holds no depth map of the scene's {len(files)} views, "
                         f"expected for instance {found.views[0].stem}.npz")
    without = [view for view, file in zip(found.views, files) if file is None]
    asked = [view for view in without if names and view.name in names]
    if asked:
        raise InputError(f"--depth-dir {str(depth_dir)!r} holds no depth map of the view {asked[0].name!r}, which was "
                         f"asked for, expected for instance {asked[0].stem}.npz")
    if without and not names:
        log.warning("%d views have no depth map in %s and serve as context views only: %s", len(without), depth_dir,
                    ", ".join(view.name for view in without[:10]) + (", ..." if len(without) > 10 else ""))
    sources = [file and DepthFile(file.resolve(), (view.camera.width, view.camera.height), depth_scale)
               for view, file in zip(found.views, files)]
    return sources if folder is not None else [source and source.load() for source in sources]
