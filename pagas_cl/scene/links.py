"""Photos and masks that lie outside their scene's folder through symbolic links: read, and told."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable
from pathlib import Path

from pagas_cl.scene.view import View

log = logging.getLogger("pagas_cl")


def tell_links(views: Iterable[View], folder: str | Path) -> list[Path]:
    """Log which files of `views` a symbolic link takes out of the scene's `folder` (or file); returns them.

    A link is made by whoever owns the disk or by whoever packed the scene, and cannot be told apart: a scene with its
    photos linked in is common, so they are read, and the caller is told where from.
    """
    folder = Path(folder)
    root = os.path.realpath(folder if folder.is_dir() else folder.parent)
    lexical, found = os.path.abspath(folder if folder.is_dir() else folder.parent), []
    for view in views:
        for source in (view.image, view.mask):
            path = getattr(source, "path", source)
            if isinstance(path, Path) and _inside(os.path.abspath(path), lexical):
                real = os.path.realpath(path)
                if not _inside(real, root):
                    found.append(path)
    if found:
        log.warning("%d photos or masks of scene %s lie outside it, through symbolic links: %s is %s; do not go on if "
                    "you do not know who made the links", len(found), folder, found[0], os.path.realpath(found[0]))
    return found


def _inside(path: str, root: str) -> bool:
    return os.path.commonpath([path, root]) == root
