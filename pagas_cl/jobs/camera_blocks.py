"""Blocks of a refinement of cameras (method section 9) by other processes: the same bytes."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyopencl as cl

from pagas_cl.errors import PagasError, log
from pagas_cl.jobs.executors import Workers
from pagas_cl.jobs.plan import groups
from pagas_cl.jobs.run import results_of
from pagas_cl.jobs.worker import Worker
from pagas_cl.method.cameras.adjust import Adjuster, Block, Frame, Wanted, blocks
from pagas_cl.runtime.memory import upload
from pagas_cl.scene.camera import Camera


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
        files = {k: self._files(adjuster, frames[k], k) for k in sorted(needed)}
        shares = [[by_target[k] for k in group] for group in groups(list(by_target), frames, self.workers.count())]
        parts = [Part(tuple(share), {k: files[k] for one in share for k in (one.target, *one.others)},
                      adjuster.scene_scale, adjuster.intrinsics) for share in shares]
        try:
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
    def frame(camera: Camera, photo: Path, depth: Path) -> Frame:
        def send():
            return upload(worker.device, np.load(photo))
        return Frame(camera, worker.photos.held(photo, 4 * camera.width * camera.height, send),
                     upload(worker.device, np.load(depth)))

    frames = {k: frame(*files) for k, files in part.frames.items()}
    adjuster = Adjuster(worker.device, part.scene_scale, part.intrinsics)
    found = blocks(adjuster, frames, part.wanted)
    depths = [adjuster.read(frames[one.target], frames[one.target].depth) for one in part.wanted]
    for used in frames.values():
        used.depth.release()
    return {one.target: pair for one, *pair in zip(part.wanted, found, depths)}
