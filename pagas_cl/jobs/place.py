"""Where a run does its work, and where it keeps what is finished."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from types import NoneType

from pagas_cl.errors import InputError, check_kind, kind_of
from pagas_cl.jobs.camera_blocks import BlocksByWorkers
from pagas_cl.jobs.executors import Workers
from pagas_cl.jobs.work_folder import one_run, work_folder
from pagas_cl.method.cameras.adjust import MakeBlocks, blocks
from pagas_cl.method.splat import PhotoStore
from pagas_cl.runtime.device import Device, Devices, is_remote, one_of, open_device


@dataclass(frozen=True, eq=False)
class Place:
    """Where the work is done, and where finished views are kept: parameters of refine_views."""

    device: Devices | None = None
    executor: Executor | str | None = None
    folder: str | Path | None = None

    def __post_init__(self) -> None:
        for name in self.device if isinstance(self.device, (list, tuple)) else [self.device]:
            check_kind("device", name, (str, Device, NoneType), "the name of an OpenCL device, or a list of names")
        if not (isinstance(self.executor, (str, NoneType)) or hasattr(self.executor, "submit")):
            raise InputError(f"executor is {kind_of(self.executor)}, expected a concurrent.futures.Executor, or the "
                             "address of a Dask scheduler")
        check_kind("folder", self.folder, (str, os.PathLike, NoneType), "the path of a folder")

    def photos(self) -> PhotoStore | None:
        """Room for photos on the one device of this process; None where other processes work."""
        return None if is_remote(self.executor, self.device) else self.photos_here()

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
        with nullcontext() if self.folder is None else one_run(Path(self.folder)):
            for left in work.glob("cameras-*") if work else ():      # of killed runs
                shutil.rmtree(left, ignore_errors=True)
            workers = Workers(self.executor, self.device)
            try:      # workers know photos by their files' names, which therefore never come again
                with tempfile.TemporaryDirectory(prefix="cameras-", dir=work) as scratch:
                    yield BlocksByWorkers(workers, Path(scratch))
            finally:
                workers.close()
