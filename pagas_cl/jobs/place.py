"""Where a run does its work, and where it keeps what is finished; blocks of a refinement of cameras (method section 9)
by other processes: the same bytes."""

import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import NoneType

import numpy as np
import pyopencl as cl

from pagas_cl.errors import InputError, PagasError, check_kind, kind_of, log
from pagas_cl.jobs.plan import groups
from pagas_cl.jobs.pools import Workers, workers_of
from pagas_cl.jobs.run import results_of
from pagas_cl.jobs.work_folder import one_run, work_folder
from pagas_cl.jobs.worker import Worker
from pagas_cl.method.cameras.adjust import Adjuster, Block, Frame, MakeBlocks, Wanted, blocks
from pagas_cl.method.splat import PhotoStore
from pagas_cl.runtime.device import Device, Devices, is_remote, one_of, open_device
from pagas_cl.runtime.memory import release, upload
from pagas_cl.scene.camera import Camera
from pagas_cl.system.files import writing


@dataclass(frozen=True, eq=False)
class Place:
    """Where the work is done, and where finished views are kept: parameters of refine_views."""

    device: Devices | None = None
    executor: Executor | str | Workers | None = None
    folder: str | Path | None = None

    def __post_init__(self) -> None:
        several = isinstance(self.device, (list, tuple))
        for name in self.device if several else [self.device]:
            check_kind("device", name, (str, NoneType) if several else (str, Device, NoneType),
                       "the name of an OpenCL device, a list of names, or pagas_cl.Device.of(queue)")
        if not (isinstance(self.executor, (str, NoneType)) or hasattr(self.executor, "submit")):
            raise InputError(f"executor is {kind_of(self.executor)}, expected a concurrent.futures.Executor, or the "
                             "address of a Dask scheduler")
        check_kind("folder", self.folder, (str, os.PathLike, NoneType), "the path of a folder")
        if self.folder == "":
            raise InputError("folder is '', expected the path of a folder ('.' is the current one)")

    @contextmanager
    def at_work(self) -> Iterator[tuple["Place", PhotoStore | None]]:
        """Context of this place and of photos on its device; of a place with workers, started once, and no photos."""
        if is_remote(self.executor, self.device):
            with workers_of(self.executor, self.device) as workers:
                yield replace(self, executor=workers), None
            return
        photos = self.photos_here()
        try:
            yield self, photos
        finally:
            photos.clear()

    def photos_here(self) -> PhotoStore:
        """Room for photos on the device that measures in this process."""
        return PhotoStore(open_device(one_of(self.device)))

    @contextmanager
    def blocks(self) -> Iterator[MakeBlocks]:
        """Context of what adds up the normal equations of cameras: `blocks`, or workers."""
        if not is_remote(self.executor, self.device):
            yield blocks
            return
        work = None if self.folder is None else work_folder(Path(self.folder).resolve())
        with one_run(self.folder):
            for left in work.glob("cameras-*") if work else ():      # of killed runs
                shutil.rmtree(left, ignore_errors=True)
            # workers know photos by their files' names, which therefore never come again
            with (workers_of(self.executor, self.device) as workers,
                  tempfile.TemporaryDirectory(prefix="cameras-", dir=work) as scratch):
                yield BlocksByWorkers(workers, Path(scratch))


@dataclass(frozen=True)
class Part:
    """Targets for one worker, and what they need by place: cameras, files of normalised photos and of depths."""

    wanted: tuple[Wanted, ...]
    frames: dict[int, tuple[Camera, Path, Path]]
    scene_scale: float
    intrinsics: bool


class BlocksByWorkers:
    """`blocks` by workers, which read photos and depths from `folder`; here from where these fail on."""

    def __init__(self, workers: Workers, folder: Path):
        self.workers, self.folder, self._failed = workers, folder, False

    def __call__(self, adjuster: Adjuster, frames: Sequence[Frame], wanted: Sequence[Wanted]) -> list[Block | None]:
        if self._failed:
            return blocks(adjuster, frames, wanted)
        by_target = {one.target: one for one in wanted}
        needed = {k for one in wanted for k in (one.target, *one.others)}
        shares = [[by_target[k] for k in group] for group in groups(list(by_target), frames, self.workers.count())]
        try:
            with writing(self.folder):
                files = {k: self._files(adjuster, frames[k], k) for k in sorted(needed)}
            parts = [Part(tuple(share), {k: files[k] for one in share for k in (one.target, *one.others)},
                          adjuster.scene_scale, adjuster.intrinsics) for share in shares]
            found = {}
            for of_part in results_of(self.workers, blocks_of, parts):
                found.update(of_part)
        except PagasError as error:
            log.warning("cameras are refined in this process, since workers cannot: %s", error)
            self._failed = True
            return blocks(adjuster, frames, wanted)
        for one in wanted:
            cl.enqueue_copy(adjuster.device.queue, frames[one.target].depth, found[one.target][1])
        return [found[one.target][0] for one in wanted]

    def _files(self, adjuster: Adjuster, frame: Frame, place: int) -> tuple[Camera, Path, Path]:
        photo, depth = (self.folder / f"{place}-{frame.size.width}{kind}.npy" for kind in ("", "-depth"))
        if not photo.exists():         # at one size it stays the same, depths do not
            np.save(photo, adjuster.read(frame, frame.normal))
        np.save(depth, adjuster.read(frame, frame.depth))
        return frame.camera, photo, depth


def blocks_of(part: Part, worker: Worker) -> dict[int, tuple[Block | None, np.ndarray]]:
    """In a worker: of each target its Block, and its depth map afterwards."""
    frames = {}
    for k, (camera, photo, depth) in part.frames.items():
        normal = worker.photos.held(photo, 4 * camera.size.pixels,
                                    lambda photo=photo: upload(worker.device, np.load(photo)))
        frames[k] = Frame(camera, normal, upload(worker.device, np.load(depth)))
    adjuster = Adjuster(worker.device, part.scene_scale, part.intrinsics)
    found = blocks(adjuster, frames, part.wanted)
    depths = [adjuster.read(frames[one.target], frames[one.target].depth) for one in part.wanted]
    release(*(used.depth for used in frames.values()))
    return {one.target: pair for one, *pair in zip(part.wanted, found, depths)}
