"""One column of the table's MATRIX: run in a terminal or a pipe and from Python, and compared."""

from pathlib import Path

from paths.run import in_pipe, in_terminal, killed
from paths.table import ON_A_TERMINAL, columns
from paths.truth import Scenes

from pagas_cl import align_depth_scales, find_depth, preset, read_scene, refine_mesh, refine_views, save_depth
from pagas_cl.config import Config
from pagas_cl.jobs.fusing import fuse_results
from pagas_cl.scene.depthmap import load_depth
from pagas_cl.scene.meshes.files import write_mesh

SETTINGS = {"pyramid.steps": "10"}
FROM_A_MESH = {"mesh": "mesh", "keep": "displace", "fuse": "tsdf"}      # what refine_mesh calls the same
DATA = (".npz", ".ply", ".obj", ".stl", ".off", ".glb", "cameras.json")


def chosen(paths) -> list:
    """Numbers of the columns with one of these `paths`, as pytest takes them."""
    return [k for k, column in enumerate(columns()) if column["path"] in paths]


def label(number: int) -> str:
    column = columns()[number]
    return f"{number}-{column['path']}-off{column['off']}-{column['run']}"


def effects_of(column) -> dict[str, str]:
    return {name: word for name, word in column.items() if word in ("auto", "on", "off")}


def stays_off(column) -> bool:
    """Whether cameras that are off stay so: a surface need not get better then, and a run may say that none did."""
    return column["off"] != "0" and column["cameras"] == "off"


def arguments_of(column, scene: Path, out: Path) -> list[str]:
    """The command line of a column."""
    start = (["--depth-dir", scene / "depth_initial"] if column["path"] in ("new", "maps")
             else ["--mesh", scene / "mesh_coarse.ply"])
    arguments = ["refine", scene, *start]
    for name, more in (("--save-depth", [out / "maps"]), ("--report", [out / "page"]), ("--memory", [400]),
                       ("--quiet", []), ("--no-align", [])):
        arguments += [name, *more] if column[name] == "yes" else []
    arguments += {"keep": ["--keep-mesh"], "fuse": ["--fuse"]}.get(column["path"], [])
    arguments += ["--output", out / f"made{column['kind']}"] if column["path"] != "maps" else []
    arguments += [word for name, value in SETTINGS.items() for word in ("--set", f"{name}={value}")]
    arguments += [word for name, choice in effects_of(column).items() for word in ("--effect", f"{name}={choice}")]
    return [str(word) for word in arguments]


class Heard:
    """A function that progress is reported to; fails where it goes back or past its end."""

    def __init__(self):
        self.stages = {}

    def __call__(self, stage: str, done: float, total: float) -> None:
        assert self.stages.get(stage, 0.0) <= done <= total, (stage, done, total)
        self.stages[stage] = done


def called(column, scene: Path, out: Path) -> list:
    """The same from Python, into `out`; the cameras that its depth maps came with, or [] from a mesh."""
    config = Config.with_settings(preset("balanced"), pyramid__steps=(10,), **{
        f"effects__{name}": choice for name, choice in effects_of(column).items()})
    progress = Heard() if column["call"] == "bar" else None
    made, views, results = out / f"made{column['kind']}", read_scene(scene).views, []
    if column["path"] in FROM_A_MESH:
        write_mesh(made, refine_mesh(scene / "mesh_coarse.ply", [view.camera for view in views],
                                     [view.image for view in views], config=config, progress=progress,
                                     output=FROM_A_MESH[column["path"]]))
    else:
        depths = [load_depth(find_depth(scene / "depth_initial", view.name)) for view in views]
        if column["--no-align"] == "no":
            depths = align_depth_scales(views, depths).apply(depths)
        results = refine_views(views, depths, config=config, progress=progress)
        for view, result in zip(views, results):
            save_depth(out / "maps" / f"{view.stem}.npz", result.depth)
        if column["path"] == "new":
            write_mesh(made, fuse_results(views, results, config, progress))
    assert progress is None or "refine" in progress.stages
    return [result.camera for result in results]


def data_in(folder: Path) -> dict[str, bytes]:
    """Meshes, depth maps and cameras below a folder, without the work folders of runs."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file() and path.name.endswith(DATA)]
    return {str(path.relative_to(folder)): path.read_bytes() for path in files
            if not any(part.startswith(".") for part in path.relative_to(folder).parts)}


def check_column(number: int, by_error: dict[str, Scenes], folder: Path) -> None:
    """Run a column every way: the same bytes come out, and the error has fallen."""
    column = columns()[number]
    scenes = by_error[column["off"]]
    scene, out, python = scenes.path(column["off"]), folder / "out", folder / "python"
    arguments, statuses, first = arguments_of(column, scene, out), (0, 3) if stays_off(column) else (0,), None
    if column["run"] == "kill":
        killed(arguments, out)
    if column["run"] != "once":
        terminal = in_terminal([*arguments, *ON_A_TERMINAL])
        terminal.must_end_well(*statuses)
        assert ("━" in terminal.raw) == (column["--quiet"] == "no"), "a bar is drawn unless --quiet is given"
        first, statuses = data_in(out), (terminal.status,)
    if column["run"] != "kill":
        pipe = in_pipe(arguments)
        pipe.must_end_well(*statuses)
        assert "\x1b" not in pipe.raw
    found = data_in(out)
    if first is not None:
        _same(found, first, "in a pipe and in a terminal")
    cameras = called(column, scene, python)
    here = data_in(python)
    both = here.keys() & found.keys()
    assert both, f"{sorted(found)} came out of the command"
    _same(*({name: files[name] for name in both} for files in (here, found)), "from Python and of the command")
    if not stays_off(column):
        check_better(column, scenes, out, cameras)


def _same(ones: dict[str, bytes], others: dict[str, bytes], where: str) -> None:
    assert ones.keys() == others.keys(), f"{where} other files come out"
    apart = [name for name in ones if ones[name] != others[name]]
    assert not apart, f"{where} these differ: {apart}"


def check_better(column, scenes: Scenes, out: Path, cameras) -> None:
    if column["--save-depth"] == "yes":
        assert scenes.of_maps(out / "maps") < 0.9 * scenes.before
    if column["path"] != "maps":
        assert scenes.of_mesh(out / f"made{column['kind']}", cameras or scenes.cameras) < 0.9 * scenes.before
