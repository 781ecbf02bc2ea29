"""Our step's parameters as a MeshLab script (.mlx) holds them. Lengths are relative: pixels and footprints.

A MeshLab script would store a length as an absolute number and apply it to the next mesh, whatever its size.
"""

from __future__ import annotations

from dataclasses import dataclass
from difflib import get_close_matches

from pagas_cl.commands._settings import build_config, effect_settings
from pagas_cl.config import Config
from pagas_cl.errors import InputError

FILTER = "PAGaS Depth Refinement"


@dataclass(frozen=True)
class Parameter:
    """One parameter: its name in .mlx and in Python, MeshLab's type, the setting it changes, and what it is."""

    name: str
    python: str
    rich: str
    default: str | None
    setting: str | None
    description: str


PARAMETERS = (
    Parameter("preset", "preset", "RichString", "balanced", None, "Settings to start from"),
    Parameter("output", "output", "RichString", "tsdf", None,
              "tsdf: a new mesh fused from the refined depths; displace: the layer's own vertices move"),
    Parameter("subdivide", "subdivide", "RichFloat", "0", None,
              "With displace: first split edges longer than this many pixel footprints (0: split none)"),
    Parameter("device", "device", "RichString", "", None, "Part of an OpenCL device's name (empty: the best one)"),
    Parameter("contextViews", "context_views", "RichInt", None, "context.number", "Most context views of a view"),
    Parameter("radius", "radius", "RichFloat", None, "splatting.radius", "Radius threshold, pixels"),
    Parameter("smoothness", "smoothness", "RichFloat", None, "smoothness.weight", "Weight of the smoothness term"),
    Parameter("maxMove", "max_move", "RichFloat", None, "solver.max_move",
              "Depths that move by more pixels of parallax are refused"),
    Parameter("voxel", "voxel", "RichFloat", None, "fusion.voxel", "Edge of a voxel, pixel footprints"),
    Parameter("agreeViews", "agree_views", "RichInt", None, "fusion.agree_views",
              "Keep only depths that this many other views confirm (0: all)"),
    Parameter("effects", "effects", "RichString", "", None,
              "Effects to simulate or not: exposure=off; occlusion=on (auto, on, off or set), separated by semicolons"),
    Parameter("settings", "settings", "RichString", "", None,
              "Any other settings: stage.field=value, separated by semicolons"),
)
_BY_NAME = {parameter.name: parameter for parameter in PARAMETERS}


@dataclass(frozen=True)
class Request:
    """What one step asks for, checked."""

    config: Config
    output: str
    subdivide: float | None
    device: str | None


def read_parameters(given: list[dict], where: str) -> dict[str, str]:
    """{name: value} of the <Param> attributes of our step in a script; refuses unknown names and wrong types."""
    values: dict[str, str] = {}
    for attributes in given:
        name = attributes.get("name", "")
        parameter = _BY_NAME.get(name)
        if parameter is None:
            near = get_close_matches(name, _BY_NAME, n=1, cutoff=0.0)[0]
            raise InputError(f"{where}: unknown parameter {name!r}; the nearest known one is {near!r}")
        if name in values:
            raise InputError(f"{where}: parameter {name!r} is there twice")
        if attributes.get("type") != parameter.rich:
            raise InputError(f"{where}: parameter {name!r} has type {attributes.get('type')!r}, expected "
                             f"{parameter.rich!r}")
        if attributes.get("value") is None:
            raise InputError(f"{where}: parameter {name!r} has no value")
        values[name] = attributes["value"]
    return values


def request(values: dict[str, str], where: str) -> Request:
    """Check the values of a step, and turn them into settings."""
    values = {**{p.name: p.default for p in PARAMETERS if p.default is not None}, **values}
    assignments = []
    for name, value in values.items():
        _check_number(_BY_NAME[name], value, where)
        if _BY_NAME[name].setting:
            assignments.append(f"{_BY_NAME[name].setting}={value}")
    assignments += effect_settings([part for part in values["effects"].split(";") if part.strip()])
    assignments += [part for part in values["settings"].split(";") if part.strip()]
    if values["output"] not in ("tsdf", "displace"):
        raise InputError(f"{where}: output is {values['output']!r}, expected 'tsdf' or 'displace'")
    subdivide = float(values["subdivide"]) or None
    if subdivide is not None and subdivide < 0.25:
        raise InputError(f"{where}: subdivide is {subdivide:g}, expected 0 or at least 0.25 pixel footprints")
    try:
        config = build_config(values["preset"], assignments)
    except InputError as error:
        raise InputError(f"{where}: {error}") from error
    return Request(config, values["output"], subdivide, values["device"] or None)


def _check_number(parameter: Parameter, value: str, where: str) -> None:
    from pagas_cl.scene.readers.untrusted import word

    if parameter.rich in ("RichInt", "RichFloat"):
        number = word(value, f"{where}: {parameter.name}")
        if parameter.rich == "RichInt" and ("." in value or "e" in value.lower() or abs(number) > 2**31):
            raise InputError(f"{where}: {parameter.name} is {value!r}, expected a whole number")


def to_values(**given) -> dict[str, str]:
    """Values for `request` from Python arguments, named as Parameter.python; None leaves the preset's."""
    values = {}
    for parameter in PARAMETERS:
        value = given.pop(parameter.python, None)
        if value is not None:
            if not isinstance(value, (str, int, float)) or isinstance(value, bool) \
                    or isinstance(value, str) != (parameter.rich == "RichString"):
                kind = "text" if parameter.rich == "RichString" else "a number"
                raise InputError(f"{parameter.python} is {value!r}, expected {kind}")
            values[parameter.name] = value if isinstance(value, str) else repr(value)
    if given:
        raise InputError(f"unknown parameter {next(iter(given))!r}, expected {', '.join(p.python for p in PARAMETERS)}")
    return values
