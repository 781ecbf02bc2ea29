"""What the stages of a command take on two cores of a CPU: seconds that an Outlook starts from, and corrects.

Measured with the scene of tests/bench/told.py. What counts is how long stages are beside one another; on a GPU the
device's work is a hundredth of it.
"""

from collections.abc import Sequence

from pagas_cl.config import Config
from pagas_cl.costs import RUNS, Cost
from pagas_cl.effects import EFFECTS, agreement_rounds, between_rounds
from pagas_cl.progress import Outlook
from pagas_cl.scene.view import View

_COLOUR = Cost(photo=0.03, setup=8e-8, per_step=2.9e-8, per_view_step=2.9e-8)
_GREY = Cost(photo=0.03, setup=8e-8, per_step=1.5e-8, per_view_step=1.5e-8)
_GPU, _KERNELS, _VIEWER = 0.01, 0.5, 0.8        # seconds to load kernels, of the first page with a mesh
_AVERAGE, _MEASURE, _MEASURED = 3e-7, 3.5e-7, 6     # seconds a pixel; views that are measured for the cameras
_RENDER, _PICTURES, _PLAN, _FUSE, _EXTRACT, _SHOW = 3e-8, 1.4e-6, 1.6e-7, 4.6e-7, 1e-7, 3e-7      # a pixel
_SOLVE = 7e-7           # a pixel, where the device solves the mesh


class Expected:
    """Tells `progress` what is to come of the `views` that are asked for; nothing where it does not want to know."""

    def __init__(self, progress, views: Sequence[View], config: Config, device):
        self.progress = progress
        self.outlook = progress if isinstance(progress, Outlook) else Outlook()
        self.sizes = [view.camera.width * view.camera.height for view in views]
        self.pixels, self.config = sum(self.sizes), config
        self.contexts = max(0, min(config.context.number, len(views) - 1))
        self.kind = "device"
        self.scale = 1.0 if getattr(getattr(device, "info", None), "kind", "GPU") == "CPU" else _GPU

    def cameras(self, mesh: bool) -> None:
        if self.config.effects.cameras not in ("off", "set"):
            share = min(1.0, _MEASURED / max(len(self.sizes), 1))
            self._device("measure the cameras", _KERNELS + (share * _MEASURE + _RENDER * mesh) * self.pixels)

    def mesh_drawn(self) -> None:
        self._device("render the mesh", _RENDER * self.pixels)

    def rounds(self, pictures: bool) -> None:
        """Refining all views, and their pictures."""
        for stage, seconds in self._refining():
            self._device(stage, seconds)
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
        self._device("time the settings", RUNS * self._view(short, max(self.sizes)))

    def timed(self, config: Config, seconds: float) -> None:
        """These settings were chosen, which take so long on this device."""
        self.config, self.kind = config, "timed"
        self.scale = seconds / sum(expected for _, expected in self._refining())
        self.rounds(pictures=False)

    def made(self, shown: bool, solved: bool) -> None:
        if solved:
            self._device("solve the mesh", _SOLVE * self.pixels)
        else:
            for stage, seconds in (("plan the mesh", _PLAN), ("fuse", _FUSE), ("extract the mesh", _EXTRACT)):
                self._host(stage, seconds)
        if shown:
            self._host("show the mesh", _SHOW + _VIEWER / self.pixels)

    def analyzed(self, costs: bool) -> None:
        self._device("analyze", _KERNELS + _MEASURE * self.pixels)
        if costs:
            timed = self.config.with_settings(pyramid__scales=(1.0,), pyramid__steps=(20,))
            self._device("time the effects", len(EFFECTS) * self._view(timed, max(self.sizes)))

    def _views(self, config: Config) -> float:
        return sum(self._view(config, pixels) for pixels in self.sizes)

    def _view(self, config: Config, pixels: int) -> float:
        return (_GREY if config.loss.grey else _COLOUR).seconds(config, pixels, self.contexts)

    def _device(self, stage: str, seconds: float) -> None:
        self.outlook.expect(stage, self.scale * seconds, self.kind)

    def _host(self, stage: str, seconds: float) -> None:
        self.outlook.expect(stage, seconds * self.pixels, "host")
