"""What the stages of a command take on one core of a CPU: seconds that an Outlook starts from, and corrects.

Measured with the scene of tests/bench/told.py. What counts is how long stages are beside one another; on a GPU the
device's work is some two hundredth of it.
"""

from collections.abc import Sequence

from pagas_cl.config import Config
from pagas_cl.costs import RUNS, Cost
from pagas_cl.effects import EFFECTS, agreement_rounds, between_rounds
from pagas_cl.outlook import Course, Outlook, even
from pagas_cl.remembered import Remembered
from pagas_cl.scene.view import View

_COLOUR = Cost(photo=0.03, setup=1.6e-7, per_step=5.8e-8, per_view_step=5.8e-8)
_GREY = Cost(photo=0.03, setup=1.6e-7, per_step=3e-8, per_view_step=3e-8)
_GPU, _VIEWER = 0.005, 0.8     # of a core; seconds of the first page with a mesh
_GPU_BUILDS = 0.35              # of what PoCL takes to build kernels (NVIDIA's driver on an H200)
_AVERAGE, _MEASURE, _MEASURED = 3e-7, 6e-7, 6   # seconds a pixel; views that are measured for the cameras
_RENDER, _PICTURES, _PLAN, _FUSE, _EXTRACT, _SHOW = 1e-7, 1.8e-6, 1.6e-7, 4.6e-7, 1e-7, 5e-7      # a pixel
_SOLVE = 7e-6                   # a pixel, where the device solves the mesh,
_FULL, _SEEN = 10.0, 1.2e-6     # or, where memory ends it, for that, and a pixel;
_HOST = 0.1                     # share of it that is the host's


class Expected:
    """Tells `progress` what is to come of the `views` that are asked for; nothing where it does not want to know."""

    def __init__(self, progress, views: Sequence[View], config: Config, device):
        self.progress = progress
        self.outlook = progress if isinstance(progress, Outlook) else Outlook()
        self.sizes = [view.camera.width * view.camera.height for view in views]
        self.pixels, self.config = sum(self.sizes), config
        self.contexts = max(0, min(config.context.number, len(views) - 1))
        self.kind = "device"
        info = getattr(device, "info", None)        # of one device that is open here
        cpu = info is not None and info.kind == "CPU"
        self.scale, self.builds = (1 / max(1, info.compute_units), 1.0) if cpu else (_GPU, _GPU_BUILDS)
        self.remembered = Remembered(info) if info else None
        self._told = dict[str, tuple[float, float, float]]()    # stages: work, usual seconds, share of building in them

    def cameras(self, mesh: bool, analyzed: bool = False) -> None:
        if self.config.effects.cameras not in ("off", "set"):
            share = min(1.0, _MEASURED / max(len(self.sizes), 1))
            self._device("measure the cameras", (share * _MEASURE + _RENDER * mesh) * self.pixels, 3.2 * (not analyzed))

    def mesh_drawn(self) -> None:
        self._device("render the mesh", _RENDER * self.pixels, 0.8)

    def rounds(self, pictures: bool) -> None:
        """Refining all views, and their pictures."""
        for stage, seconds in self._refining():
            self._device(stage, seconds, {"refine": 5.3, "agree, round 1": 1.5}.get(stage, 0.0))
        if pictures:
            self._host("pictures", _PICTURES)

    def _refining(self) -> list[tuple[str, float]]:
        measured = _MEASURE * self.pixels if self.config.effects.measured else 0.0
        again, rounds = between_rounds(self.config), agreement_rounds(self.config, len(self.sizes))
        stages = [("refine", measured + self._views(self.config))]
        for number in range(1, rounds + 1):
            steps = measured + self._views(again) if number < rounds and again else 0.0
            stages.append((f"agree, round {number}", _AVERAGE * self.pixels + steps))
        return stages

    def probed(self) -> None:
        """Of finding the settings that fit a time, before they are refined with (`timed`)."""
        short = self.config.with_settings(pyramid__scales=(1.0,), pyramid__steps=(20,))
        self._device("time the settings", RUNS * self._view(short, max(self.sizes)), 4.0)

    def timed(self, config: Config, seconds: float) -> None:
        """These settings were chosen, which take so long on this device."""
        self.config, self.kind = config, "timed"
        self.scale = seconds / sum(expected for _, expected in self._refining())
        self.rounds(pictures=False)

    def made(self, shown: bool, solved: bool) -> None:
        if solved:
            self._device("solve the mesh", min(_SOLVE * self.pixels, _FULL + _SEEN * self.pixels), 3.0, host=_HOST)
        else:
            for stage, seconds in (("plan the mesh", _PLAN), ("fuse", _FUSE), ("extract the mesh", _EXTRACT)):
                self._host(stage, seconds)
        if shown:
            self._host("show the mesh", _SHOW + _VIEWER / self.pixels)

    def analyzed(self, costs: bool) -> None:
        self._device("analyze", _MEASURE * self.pixels, 2.5)
        if costs:
            timed = self.config.with_settings(pyramid__scales=(1.0,), pyramid__steps=(15,))      # as measured
            self._device("time the effects", len(EFFECTS) * self._view(timed, max(self.sizes)), 5.5, 5.0)
        self._device("compare the depth maps", _AVERAGE * self.pixels, 0.3)

    def _views(self, config: Config) -> float:
        return sum(self._view(config, pixels) for pixels in self.sizes)

    def _view(self, config: Config, pixels: int) -> float:
        return (_GREY if config.loss.grey else _COLOUR).seconds(config, pixels, self.contexts)

    def remember(self) -> None:
        """At the end of a run: what its stages took, for the next one, without what building kernels should have taken
        of those that were never seen: their parts are taken for equal."""
        kept = {}
        for stage, (share, speed, course) in self.outlook.courses().items():
            if stage in self._told:
                (work, usual, built), took = self._told[stage], course[-1][1]
                rest = (1 - built) * max(took, min(1.0, speed) * share * usual)      # maybe they were there
                kept[stage] = share * work, even(min(rest, took)) if built else course
        if self.remembered and kept:
            self.remembered.keep(kept)

    def _host(self, stage: str, seconds: float) -> None:
        self._expect(stage, seconds * self.pixels, even(seconds * self.pixels), "host")

    def _device(self, stage: str, seconds: float, first: float = 0.0, later: float = 0.0, host: float = 0.0) -> None:
        """Kernels that it is the first to use are built in so many seconds more, at `first` and `later`; the driver
        keeps them (measured: PoCL). `host`: a share that no device makes faster."""
        work, first, later = max(self.scale, host) * seconds, self.builds * first, self.builds * later
        self._expect(stage, seconds, even(work + later, first), self.kind, first + later)

    def _expect(self, stage: str, work: float, usual: Course, kind: str, build: float = 0.0) -> None:
        seen = self.remembered.course(stage, work) if self.remembered else None
        self._told[stage] = work, usual[-1][1], build / usual[-1][1] if seen is None else 0.0
        known = seen is not None and kind != "timed"
        self.outlook.expect(stage, seen if known else usual, kind, known)
