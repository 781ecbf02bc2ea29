"""A pinhole camera in the one convention that is used everywhere inside (method section 2)."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pagas_cl.errors import InputError, check_kind, kind_of, short
from pagas_cl.scene.images import as_array

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])       # from OpenGL's axes of a camera to those used here, and back
_ROTATION_TOLERANCE = 1e-3  # text formats keep 4 to 6 digits


class Size(NamedTuple):
    """Width and height of an image in pixels."""

    width: int
    height: int

    @property
    def pixels(self) -> int:
        return self.width * self.height

    @property
    def shape(self) -> tuple[int, int]:
        """Of an array of its pixels."""
        return self.height, self.width

    @property
    def extent(self) -> dict[str, int]:
        """As kernels name it."""
        return self._asdict()

    def scaled(self, scale: float) -> "Size":
        """That of the image at `scale` of its size, at least a pixel."""
        return Size(max(1, round(self.width * scale)), max(1, round(self.height * scale)))


@dataclass(frozen=True, eq=False)
class Camera:
    """Pinhole camera: size, focal lengths and principal point in pixels, and a rigid pose (4, 4) in scene units.

    Convention: looks along +z, x right, y down (OpenCV, COLMAP). The image origin is the top-left corner: pixel (row v,
    column u) has its centre at (u + 0.5, v + 0.5). All numbers are float64. `name`: the view's, in messages and files.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_to_camera: npt.NDArray[np.float64] = field(repr=False)
    name: str = ""

    def __post_init__(self) -> None:
        check_kind("name of a camera", self.name, (str,), "text, such as its photo's file name")
        who = f"camera {self.name!r}" if self.name else "camera"
        for side in ("width", "height"):
            given, value = getattr(self, side), _number(getattr(self, side))
            if not value.is_integer() or value < 1:
                raise InputError(f"{who}: {side} is {short(given)}, expected a whole number of pixels of at least 1")
            object.__setattr__(self, side, int(value))
        for number in ("fx", "fy", "cx", "cy"):
            given, value = getattr(self, number), _number(getattr(self, number))
            if not np.isfinite(value) or (number[0] == "f" and value <= 0):
                raise InputError(f"{who}: {number} is {short(given) if np.isnan(value) else value}, expected a finite "
                                 "number of pixels"
                                 + (" above 0" if number[0] == "f" else ""))
            object.__setattr__(self, number, value)
        object.__setattr__(self, "world_to_camera", _checked_pose(self.world_to_camera, who))

    @classmethod
    def from_opencv_w2c(cls, K: npt.ArrayLike, world_to_camera: npt.ArrayLike, width: int, height: int, *,
                        pixel_center: float = 0.5, name: str = "") -> "Camera":
        """From OpenCV axes (x right, y down, z forward), K (3, 3) in pixels and a pose (3, 4) or (4, 4).

        `pixel_center` is where K puts the centre of the top-left pixel: 0.5 (COLMAP; rays of Open3D) or 0 (OpenCV's
        calibration, OpenMVS, Open3D's legacy cameras).
        """
        K = as_array(K, f"camera {name!r}: K", "(3, 3)").astype(np.float64)
        if K.shape != (3, 3):
            raise InputError(f"camera {name!r}: K has shape {K.shape}, expected (3, 3)")
        if not np.abs([K[1, 0], K[2, 0], K[2, 1], K[2, 2] - 1]).max() <= 1e-6:
            raise InputError(f"camera {name!r}: K is {short(K.tolist())}, expected [[fx, 0, cx], [0, fy, cy], "
                             "[0, 0, 1]]: transpose it, or divide it by its last number")
        if abs(K[0, 1]) > 1e-6 * abs(K[0, 0]):
            raise InputError(f"camera {name!r}: K has skew {K[0, 1]:g}, expected 0; undistort the photos first")
        shift = 0.5 - _number(pixel_center)
        if not np.isfinite(shift):
            raise InputError(f"camera {name!r}: pixel_center is {short(pixel_center)}, expected 0.5 or 0")
        pose = _checked_pose(world_to_camera, f"camera {name!r}")
        return cls(width, height, K[0, 0], K[1, 1], K[0, 2] + shift, K[1, 2] + shift, pose, name)

    @classmethod
    def from_c2w(cls, K: npt.ArrayLike, camera_to_world: npt.ArrayLike, width: int, height: int, *,
                 pixel_center: float = 0.5, name: str = "") -> "Camera":
        """From OpenCV axes and a camera-to-world pose (the camera's place in the world); else as from_opencv_w2c."""
        pose = _checked_pose(camera_to_world, f"camera {name!r}")
        return cls.from_opencv_w2c(K, inverse_pose(pose), width, height, pixel_center=pixel_center, name=name)

    @classmethod
    def from_opengl_c2w(cls, K: npt.ArrayLike, camera_to_world: npt.ArrayLike, width: int, height: int, *,
                        pixel_center: float = 0.5, name: str = "") -> "Camera":
        """From OpenGL axes (x right, y up, looking along -z; nerfstudio, Blender) and a camera-to-world pose."""
        pose = _checked_pose(camera_to_world, f"camera {name!r}") @ FLIP
        return cls.from_c2w(K, pose, width, height, pixel_center=pixel_center, name=name)

    @classmethod
    def from_colmap(cls, camera: Any, image: Any) -> "Camera":
        """From pycolmap's Camera and Image (PINHOLE or SIMPLE_PINHOLE; COLMAP counts pixel centres at +0.5)."""
        if not (hasattr(camera, "model") and hasattr(image, "cam_from_world")):
            raise InputError(f"camera is {kind_of(camera)} and image {kind_of(image)}, expected a pycolmap.Camera and "
                             "its pycolmap.Image")
        model = camera.model.name if hasattr(camera.model, "name") else str(camera.model)
        if model not in ("PINHOLE", "SIMPLE_PINHOLE"):
            raise InputError(f"camera of image {image.name!r} is {model}, expected PINHOLE or SIMPLE_PINHOLE; "
                             "read_scene(folder) undistorts the photos, as colmap image_undistorter does")
        pose = image.cam_from_world
        pose = (pose() if callable(pose) else pose).matrix()
        return cls(camera.width, camera.height, camera.focal_length_x, camera.focal_length_y,
                   camera.principal_point_x, camera.principal_point_y, pose, image.name)

    @classmethod
    def from_open3d(cls, parameters: Any, *, pixel_center: float = 0.0, name: str = "") -> "Camera":
        """From Open3D's legacy PinholeCameraParameters, which count pixel centres at whole numbers."""
        if not (hasattr(parameters, "intrinsic") and hasattr(parameters, "extrinsic")):
            raise InputError(f"parameters is {kind_of(parameters)}, expected Open3D's PinholeCameraParameters, which "
                             "have an intrinsic and an extrinsic")
        intrinsic = parameters.intrinsic
        return cls.from_opencv_w2c(intrinsic.intrinsic_matrix, parameters.extrinsic, intrinsic.width,
                                   intrinsic.height, pixel_center=pixel_center, name=name)

    @property
    def K(self) -> npt.NDArray[np.float64]:
        """Intrinsics, float64 of shape (3, 3), pixel centres at +0.5."""
        return intrinsics(self.fx, self.fy, self.cx, self.cy)

    @cached_property
    def center(self) -> npt.NDArray[np.float64]:
        """Centre of projection in world coordinates, float64 of shape (3,), read only."""
        center = -self.world_to_camera[:3, :3].T @ self.world_to_camera[:3, 3]
        center.setflags(write=False)
        return center

    @property
    def direction(self) -> npt.NDArray[np.float64]:
        """Viewing direction (camera +z) in world coordinates, float64 of shape (3,), unit length."""
        return self.world_to_camera[2, :3].copy()

    def rays(self, first: int = 0, rows: int | None = None) -> npt.NDArray[np.float64]:
        """Rays through all pixel centres with z = 1, camera coordinates: float64 of shape (height, width, 3); or those
        of some `rows`, from the one number `first` on."""
        last = self.height if rows is None else first + rows
        return self.rays_at(np.arange(first, last)[:, None], np.arange(self.width))

    def rays_at(self, rows: npt.NDArray[Any], columns: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
        """The same through some pixel centres: float64 of shape (..., 3)."""
        x, y = (columns + 0.5 - self.cx) / self.fx, (rows + 0.5 - self.cy) / self.fy
        return np.stack(np.broadcast_arrays(x, y, 1.0), axis=-1)

    def project(self, points: npt.ArrayLike) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Project world `points` of shape (..., 3): pixel positions of shape (..., 2) and depth z of shape (...)."""
        points = np.asarray(points, np.float64)     # a coordinate after the other: ten times as fast as point by point
        x, y, z = self.world_to_camera[:3, :3] @ points.reshape(-1, 3).T + self.world_to_camera[:3, 3:]
        with np.errstate(divide="ignore", invalid="ignore"):
            uv = np.stack([x / z * self.fx + self.cx, y / z * self.fy + self.cy], axis=-1)
        return uv.reshape(*points.shape[:-1], 2), z.reshape(points.shape[:-1])

    def holds(self, uv: npt.NDArray[Any], z: npt.NDArray[Any], margin: float = 0.0) -> npt.NDArray[np.bool_]:
        """Which points that `project` put there lie before the camera and in its picture, `margin` pixels inside."""
        u, v = uv[..., 0], uv[..., 1]
        with np.errstate(invalid="ignore"):
            inside = (z > 0) & (u >= margin) & (v >= margin) & (u < self.width - margin) & (v < self.height - margin)
        return np.asarray(inside)

    @property
    def size(self) -> Size:
        """(width, height) of the image, pixels."""
        return Size(self.width, self.height)

    def scaled(self, scale: float) -> "Camera":
        """The same camera for the image at `scale` of its size."""
        return self.resized(*self.size.scaled(scale))

    def resized(self, width: int, height: int) -> "Camera":
        """The same camera for the image resampled to `width` x `height` (the image's corners stay in place)."""
        return self if (width, height) == (self.width, self.height) else _resized(self, width, height)

    def relative_to(self, target: "Camera") -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Rotation R (3, 3) and translation tau (3,) from `target`'s camera frame to this one (method section 3)."""
        rotation = self.world_to_camera[:3, :3] @ target.world_to_camera[:3, :3].T
        # the centres' difference keeps its digits when both are far from the origin
        return rotation, self.world_to_camera[:3, :3] @ (target.center - self.center)


@lru_cache(4096)
def _resized(camera: Camera, width: int, height: int) -> Camera:
    """The same one each time: many views use a view's rays, at the sizes of theirs."""
    sx, sy = width / camera.width, height / camera.height
    return replace(camera, width=width, height=height, fx=camera.fx * sx, fy=camera.fy * sy, cx=camera.cx * sx,
                   cy=camera.cy * sy)


def viewing_distance(cameras: list[Camera]) -> float:
    """Median distance of the cameras from the point nearest to all viewing axes (the paper's unit of the rate).

    NaN where there is none: the axes are parallel, or it lies behind most cameras.
    """
    normal_matrix, right = _axes(cameras, cameras[0].center)
    if np.linalg.eigvalsh(normal_matrix)[0] < 1e-6 * len(cameras):
        return float("nan")
    centers = np.array([camera.center - cameras[0].center for camera in cameras])
    to_point = np.linalg.solve(normal_matrix, right) - centers
    if ((to_point * [camera.direction for camera in cameras]).sum(axis=1) > 0).mean() <= 0.5:
        return float("nan")
    return float(np.median(np.linalg.norm(to_point, axis=1)))


def focus(cameras: Sequence[Camera]) -> npt.NDArray[np.float64]:
    """The point nearest to all viewing axes; of many, where these are parallel, the one nearest to the origin."""
    return np.asarray(np.linalg.lstsq(*_axes(cameras, np.zeros(3)), rcond=None)[0])


def _axes(cameras: Sequence[Camera], origin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations (3, 3), (3,) of the point nearest to all viewing axes, from `origin`."""
    axes = np.array([camera.direction for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]  # projects onto the plane across each axis
    return across.sum(axis=0), np.einsum("nij,nj->i", across, [camera.center - origin for camera in cameras])


def footprint(target: Camera, context: Camera, scene_scale: float) -> float:
    """Size of `context`'s pixel at the middle of the target at depth `scene_scale`, in units; 0 behind it."""
    rotation, tau = context.relative_to(target)
    z = rotation[2, 2] + tau[2] / scene_scale
    return max(0.0, float(z)) / float(np.sqrt(context.fx * context.fy))


def camera_table(target: Camera, contexts: list[Camera], scene_scale: float) -> np.ndarray:
    """The cameras as camera.clh reads them, target first, lengths in `scene_scale`: float32 (1 + contexts, 20)."""
    rows = []
    for camera in (target, *contexts):
        rotation, tau = camera.relative_to(target)
        rows.append([*rotation.ravel(), *(tau / scene_scale), camera.fx, camera.fy, camera.cx, camera.cy, 1 / camera.fx,
                     1 / camera.fy, camera.width, camera.height])
    return np.array(rows, np.float32)


def intrinsics(fx: float, fy: float, cx: float, cy: float) -> npt.NDArray[np.float64]:
    """K, float64 of shape (3, 3)."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def rigid(rotation: npt.ArrayLike, shift: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """The transform (4, 4) of a rotation (3, 3) and a translation (3,) after it."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, shift
    return pose


def inverse_pose(pose: np.ndarray) -> np.ndarray:
    """Inverse of a rigid 4x4 transform."""
    return rigid(pose[:3, :3].T, -pose[:3, :3].T @ pose[:3, 3])


def _number(value: Any) -> float:
    """A number as float; NaN of what is none."""
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        return float("nan")


def _checked_pose(pose: npt.ArrayLike, who: str) -> npt.NDArray[np.float64]:
    pose = as_array(pose, f"{who}: the pose", "(4, 4) or (3, 4)").astype(np.float64)
    if pose.shape == (3, 4):
        pose = np.vstack([pose, [0, 0, 0, 1]])
    if pose.shape != (4, 4):
        raise InputError(f"{who}: the pose has shape {pose.shape}, expected (4, 4) or (3, 4)")
    if not np.isfinite(pose).all():
        raise InputError(f"{who}: the pose holds values that are not finite")
    if np.abs(pose[3] - [0, 0, 0, 1]).max() > 1e-9:
        raise InputError(f"{who}: the pose's last row is {pose[3].tolist()}, expected [0, 0, 0, 1]; is it transposed?")
    R = pose[:3, :3]
    error = np.abs(R @ R.T - np.eye(3)).max()
    if error > _ROTATION_TOLERANCE or np.linalg.det(R) < 0:
        raise InputError(f"{who}: the pose's 3x3 part is no rotation (|R R^T - 1| is {error:.2g}, determinant "
                         f"{np.linalg.det(R):.4g}); remove scale and reflection first")
    pose = pose.copy()
    pose.setflags(write=False)
    return pose
