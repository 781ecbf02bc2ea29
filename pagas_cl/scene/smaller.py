"""Views at a smaller size: photo and mask are shrunk each time they are loaded."""

from dataclasses import dataclass

import numpy as np

from pagas_cl.scene.camera import Camera
from pagas_cl.scene.images import photo_to
from pagas_cl.scene.view import View, source_digest
from pagas_cl.system.files import digest_of


@dataclass(frozen=True, eq=False)
class SmallPhoto:
    """Stands for the photo of `view`, or its mask, at another `size`, (width, height)."""

    view: View
    size: tuple[int, int]
    mask: bool = False

    def load(self) -> np.ndarray:
        """uint8 (height, width, 3); of a mask bool (height, width), true where more than half of what a pixel covers is
        kept."""
        if self.mask:
            return photo_to(np.asarray(self.view.load_mask(), np.float32), *self.size) > 0.5
        return self.view.load_small([self.size])[0]

    @property
    def digest(self) -> str:
        """Hash of what `load` gives, by photo or mask and the size."""
        source = self.view.mask if self.mask else self.view.image
        return digest_of([source_digest(source).encode(), repr(self.size).encode()])


def size_at(scale: float, camera: Camera) -> tuple[int, int]:
    """Width and height of the photo of `camera` at `scale` of its size, at least a pixel."""
    return max(1, round(scale * camera.width)), max(1, round(scale * camera.height))


def smaller(view: View, scale: float) -> View:
    """The view at `scale` of its size, at least a pixel."""
    size = size_at(scale, view.camera)
    return View(view.camera.resized(*size), SmallPhoto(view, size),
                None if view.mask is None else SmallPhoto(view, size, mask=True), view.name)
