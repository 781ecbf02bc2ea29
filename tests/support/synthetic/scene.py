"""Synthetic scenes with exact ground truth: a relief under photographs, seen from a grid of views around it."""

from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from support.synthetic import photo
from support.synthetic.layout import ELLIPSE, PLANE, Relief, half_sizes, make_cameras, make_solids
from support.synthetic.mesh import solid_mesh
from support.synthetic.solid import Solid
from support.synthetic.texture import Texture, patchwork

from pagas_cl.errors import InputError
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.depthmap import save_depth
from pagas_cl.scene.images import write_image
from pagas_cl.scene.mesh import Surface
from pagas_cl.scene.meshes.files import write_mesh
from pagas_cl.scene.readers import camera_file
from pagas_cl.scene.view import View


@dataclass(frozen=True, eq=False)
class SyntheticScene:
    """A synthetic scene: `views[0]` is the target, the others its contexts; `held_out` took no part. Depth maps are
    float32 z-depth, 0 = no surface; normals are unit, in the camera's frame, towards the camera."""

    relief: Relief
    cameras: list[Camera]
    true_solid: Solid
    initial_solid: Solid
    skin: Texture
    _shared: dict = field(default_factory=dict, repr=False)

    @cached_property
    def all_views(self) -> list:
        """Target, contexts, held-out views (photos are rendered on first use)."""
        masks = [self.true_depth(camera) > 0 if self.relief.foreground else None for camera in self.cameras]
        return [View(camera, self.image(k), masks[k], camera.name) for k, camera in enumerate(self.cameras)]

    @property
    def views(self) -> list:
        return self.all_views[:1 + self.relief.contexts]

    @property
    def held_out(self) -> list:
        return self.all_views[1 + self.relief.contexts:]

    def image(self, index: int) -> np.ndarray:
        """Photo of view `index`, uint8 (height, width, 3); rendered once."""
        if ("image", index) in self._shared:
            return self._shared["image", index]
        relief, camera = self.relief, self.cameras[index]
        rng = np.random.default_rng([relief.seed, 7, index])
        jitter = rng.uniform(-1, 1, 2) * relief.exposure * (0 < index <= relief.contexts)
        side = max(camera.width, camera.height)
        backdrop = patchwork(side, side, 1.0, rng, kind="noise") if relief.foreground else None
        look = photo.Look(relief.shading, relief.shine, float(np.exp(jitter[0])), 0.1 * jitter[1], relief.noise / 255,
                          relief.seed * 1000 + index, backdrop)
        self._shared["image", index] = photo.photograph(self.true_solid, self.skin, camera, look)
        return self._shared["image", index]

    def true_depth(self, camera: Camera) -> np.ndarray:
        """Exact depth seen by `camera`, float32 (height, width)."""
        return self._depth(self.true_solid, camera)[0].astype(np.float32)

    def true_normals(self, camera: Camera) -> np.ndarray:
        """Exact normals seen by `camera`, float32 (height, width, 3)."""
        return photo.normals(self.true_solid, camera, *self._depth(self.true_solid, camera))

    def initial_depth(self, camera: Camera) -> np.ndarray:
        """Depth of the surface whose fine detail is smoothed away, float32 (height, width)."""
        return self._depth(self.initial_solid, camera)[0].astype(np.float32)

    def initial_mesh(self, spacing: float = 4.0):
        """That surface as a mesh: vertices float64 (n, 3), faces int32 (m, 3); `spacing` in target pixels."""
        return solid_mesh(self.initial_solid, spacing * self.relief.footprint,
                          half_sizes(self.relief, ELLIPSE if self.relief.foreground else PLANE))

    def _depth(self, solid, camera):
        key = id(solid), id(camera)
        if key not in self._shared:
            self._shared[key] = (*photo.depth_and_part(solid, camera), camera)  # the camera too: keeps its id taken
        return self._shared[key][:2]


def relief_scene(width: int = 388, height: int = 290, contexts: int = 10, **settings) -> SyntheticScene:
    """Make a relief scene; `settings` are the fields of `Relief`.

    `relief_scene(1554, 1162, contexts=10)` is the trial scene of the method: an object about 300 units wide, seen
    from 650, 11 degrees between neighbouring views, an initial error of about a quarter of a pixel of parallax.
    """
    known = {f.name for f in fields(Relief)}
    for name in sorted(settings.keys() - known):
        raise InputError(f"synthetic scene: unknown setting {name!r}, expected one of {', '.join(sorted(known))}")
    relief = Relief(width=width, height=height, contexts=contexts, **settings)
    rng = np.random.default_rng(relief.seed)
    true, initial = make_solids(relief, rng)
    texels = [int(np.ceil(2 * half / relief.footprint)) for half in half_sizes(relief)]
    skin = patchwork(*texels, relief.footprint, rng, kind=relief.texture, contrast=relief.contrast,
                     tile=int(np.clip(relief.width // 3, 48, 300)))
    return SyntheticScene(relief, make_cameras(relief), true, initial, skin)


def write_scene(synthetic: SyntheticScene, folder, mesh: Surface | None = None, depths=None) -> Path:
    """Write SCENE/images, cameras.json, masks, mesh_coarse.ply, depth_initial and depth_true; returns SCENE. The
    held-out views are there too, under names that start with "held_out". `mesh`, `depths`: another coarse mesh, and its
    depth maps, of all views."""
    folder = Path(folder)
    depths = depths or [synthetic.initial_depth(view.camera) for view in synthetic.all_views]
    for name in ("images", "depth_initial", "depth_true", *(["masks"] if synthetic.relief.foreground else [])):
        (folder / name).mkdir(parents=True, exist_ok=True)
    named = []
    for view, depth in zip(synthetic.all_views, depths):
        file = f"{view.name}.png"
        write_image(folder / "images" / file, view.load_image())
        if view.mask is not None:
            write_image(folder / "masks" / file, view.load_mask().astype(np.uint8) * 255)
        save_depth(folder / "depth_initial" / f"{view.name}.npz", depth)
        save_depth(folder / "depth_true" / f"{view.name}.npz", synthetic.true_depth(view.camera))
        named.append(replace(view, mask=None, name=file))
    camera_file.write(folder, named)
    write_mesh(folder / "mesh_coarse.ply", mesh or Surface(*synthetic.initial_mesh()))
    return folder
