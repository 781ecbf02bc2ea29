"""Our step's parameters as a MeshLab script (.mlx) holds them. Lengths are relative: pixels and footprints.

A MeshLab script would store a length as an absolute number and apply it to the next mesh, whatever its size.
"""

import re
from dataclasses import dataclass
from numbers import Real

from pagas_cl.config import Config
from pagas_cl.config.presets import build_config, effect_settings
from pagas_cl.errors import InputError, nearest_of, short
from pagas_cl.method.surface.mesh_options import MeshOptions
from pagas_cl.scene.untrusted import float_of, whole

FILTER = "PAGaS Depth Refinement"
_WHOLE = {"RichInt": -2**31, "RichEnum": 0, "RichMesh": 0}      # the least value
_NUMBERS = (*_WHOLE, "RichFloat", "RichAbsPerc", "RichPercentage", "RichDynamicFloat")


@dataclass(frozen=True)
class Parameter:
    name: str               # in .mlx
    rich: str               # MeshLab's type
    default: str | None     # None: the preset's
    setting: str | None     # that it changes
    description: str

    @property
    def python(self) -> str:
        """Its name in Python: context_views for contextViews."""
        return re.sub("([A-Z])", r"_\1", self.name).lower()


PARAMETERS = (
    Parameter("preset", "RichString", "balanced", None, "Settings to start from"),
    Parameter("output", "RichString", "mesh", None, "mesh: the layer's mesh refined, as a new layer; tsdf: a new mesh "
              "fused from the refined depths; displace: the layer's own vertices move"),
    Parameter("subdivide", "RichFloat", "0", None,
              "First split edges longer than this many pixel footprints (0: with displace none, with mesh 1.5)"),
    Parameter("triangles", "RichInt", "0", None,
              "With mesh: how many triangles the new layer has (0: as many as the photos' pixels show detail)"),
    Parameter("device", "RichString", "", None, "Part of an OpenCL device's name (empty: the best one)"),
    Parameter("contextViews", "RichInt", None, "context.number", "Most context views of a view"),
    Parameter("radius", "RichFloat", None, "splatting.radius", "Radius threshold, pixels"),
    Parameter("smoothness", "RichFloat", None, "smoothness.weight", "Weight of the smoothness term"),
    Parameter("maxMove", "RichFloat", None, "solver.max_move",
              "Depths that move by more pixels of parallax are refused"),
    Parameter("voxel", "RichFloat", None, "fusion.voxel", "Edge of a voxel, pixel footprints"),
    Parameter("agreeViews", "RichInt", None, "fusion.agree_views",
              "Keep only depths that this many other views confirm (0: all)"),
    Parameter("effects", "RichString", "", None,
              "Effects to simulate or not: exposure=off; occlusion=on (auto, on, off or set), separated by semicolons"),
    Parameter("settings", "RichString", "", None,
              "Any other settings: stage.field=value, separated by semicolons"),
)
TYPES = {parameter.name: parameter.rich for parameter in PARAMETERS}
IN_SCRIPTS = {parameter.python: parameter.name for parameter in PARAMETERS}      # as scripts may spell them, too


@dataclass(frozen=True)
class Request:
    """The settings of one step, checked."""

    config: Config
    making: MeshOptions
    device: str | None


def check_parameter(attributes: dict, types: dict | None, seen, where: str) -> None:
    """Refuse a <Param> whose name is not among `types` or is in `seen`, and one of another type."""
    name, kind = attributes.get("name", ""), attributes.get("type", "")
    if name in seen:
        raise InputError(f"{where}: parameter {name!r} is there twice")
    if types is not None and name not in types:
        raise InputError(f"{where}: unknown parameter {name!r}; " + (nearest_of(name, types) or (
            f"expected one of {', '.join(types)}" if types else "it takes none")))
    if types is not None and kind != types[name]:
        raise InputError(f"{where}: parameter {name!r} has type {kind!r}, expected {types[name]!r}")


def check_value(kind: str, value: str | None, what: str, choices: int | None = None) -> None:
    """Refuse what is no value of MeshLab's type `kind`; `choices`: how many an enumeration has."""
    if value is None and kind in (*_NUMBERS, "RichString"):
        raise InputError(f"{what} has no value")
    if kind in _NUMBERS:
        number = float_of(value, what)
        if kind in _WHOLE:
            whole(number, _WHOLE[kind], 2**31 if choices is None else choices - 1, what)
        if kind == "RichInt" and not re.fullmatch(r"[+-]?\d+", value):
            raise InputError(f"{what} is {value!r}, expected a whole number")
    elif kind == "RichBool" and value not in ("true", "false"):
        raise InputError(f"{what} is {short(value)}, expected 'true' or 'false'")


def request(values: dict[str, str], where: str) -> Request:
    """Check the values of our step, and turn them into settings."""
    for name, value in values.items():
        check_value(TYPES[name], value, f"{where}: {name}")
    values = {**{p.name: p.default for p in PARAMETERS if p.default is not None}, **values}
    assignments = [f"{p.setting}={values[p.name]}" for p in PARAMETERS if p.setting and p.name in values]
    if values["output"] not in ("mesh", "tsdf", "displace"):
        raise InputError(f"{where}: output is {values['output']!r}, expected 'mesh', 'tsdf' or 'displace'")
    subdivide = float(values["subdivide"]) or None
    if subdivide is not None and subdivide < 0.25:
        raise InputError(f"{where}: subdivide is {subdivide:g}, expected 0 or at least 0.25 pixel footprints")
    making = MeshOptions(values["output"], subdivide,
                         triangles=int(values["triangles"]) or None)
    try:
        making.check()
        assignments += effect_settings(_parts(values["effects"]), "effects:") + _parts(values["settings"])
        config = build_config(values["preset"], assignments, "settings:")
    except InputError as error:
        raise InputError(f"{where}: {error}") from error
    return Request(config, making, values["device"] or None)


def _parts(text: str) -> list[str]:
    return [part for part in text.split(";") if part.strip()]


def to_values(given: dict) -> dict[str, str]:
    """Values for `request` from Python arguments, named as Parameter.python; None leaves the preset's."""
    values = {}
    for parameter in PARAMETERS:
        value, text = given[parameter.python], parameter.rich == "RichString"
        if value is None:
            continue
        if isinstance(value, bool) or not isinstance(value, str if text else Real):
            raise InputError(f"{parameter.python} is {value!r}, expected {'text' if text else 'a number'}")
        values[parameter.name] = str(value)
    return values
