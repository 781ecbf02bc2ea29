"""`pagas-cl script`: a MeshLab filter script (.mlx) with our step in it, without MeshLab's window or OpenGL."""

import glob
import os
import sys
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import typer

from pagas_cl.app.commands import _options as options
from pagas_cl.app.commands._given import load_scene
from pagas_cl.app.commands._outputs import Places, check_outputs, scene_inputs
from pagas_cl.app.commands._process import nothing_refined, shown_progress
from pagas_cl.errors import InputError, log, need
from pagas_cl.filters import file_kinds, filter_script, history
from pagas_cl.scene.meshes.meshlab_layer import load_file, same_pixels, write_file
from pagas_cl.scene.readers.meshlab import MeshLayer, check_names, read_project, resolve_flavour, write_project
from pagas_cl.system.files import replaced_with_others, write_text


@nothing_refined()
def command(
    script: Path = typer.Argument(..., metavar="SCRIPT", help="The filter script (.mlx)."),
    scene: Path = typer.Argument(None, metavar="[SCENE]", help="Folder with photos and cameras, for our step."),
    mesh: Path = typer.Option(None, "--mesh", help="The mesh that the script starts from."),
    project: Path = typer.Option(None, "--project", help="A MeshLab project (.mlp): layers, and photos as scene."),
    output: Path = typer.Option(..., "--output", help="Where the current layer goes in the end (.ply, .obj ...), "
                                                      "or a .mlp for all layers."),
    layer: str = typer.Option(None, "--layer", help="With --project: the layer to start from (default: the last one)."),
    save_script: Path = typer.Option(None, "--save-script", help="Write the history, our step included, as .mlx."),
    flavour: str = typer.Option(None, "--mlp-flavour", help="How the project counts CenterPx.y: meshlab or openmvs."),
    format: str = options.FORMAT,
    photos: Path = options.PHOTOS,
    device: str = options.DEVICE,
    outside: bool = typer.Option(False, "--outside", help="Allow files outside the folders (files that you trust)."),
    overwrite: bool = options.OVERWRITE,
    quiet: bool = options.QUIET,
):
    """Run SCRIPT on a mesh, or on a MeshLab project; the whole script is checked before anything runs."""
    os.environ.setdefault("QT_LOGGING_RULES", "*.debug=false")      # else MeshLab names every filter that it reads
    pymeshlab = need("pymeshlab", "meshlab", "running a filter script")
    if (mesh is None) == (project is None):
        raise InputError("expected either --mesh or --project (what the script starts from), got "
                         + ("neither" if mesh is None else "both"))
    if photos is not None and scene is None:
        raise InputError("--photos names the photos of SCENE, which is not given")
    layers, found = _sources(mesh, project, None if scene is None else load_scene(scene, format, outside, photos),
                             flavour, outside)
    inputs = {"the script": script, "--mesh": mesh, "--project": project, "SCENE": scene, "--photos": photos,
              **{f"the file of layer {entry.label!r}": entry.path for entry in layers},
              **({} if found is None else scene_inputs(found))}
    check_outputs(_places(output, save_script, found), [], inputs, overwrite)
    steps = filter_script.check_script(script, outside=outside)
    with _meshlab_chatter(quiet):
        kind = None if output.suffix.lower() == ".mlp" else file_kinds.file_kind(output)
        meshes = pymeshlab.MeshSet()
        names = {name for entry in layers for name in load_file(meshes, entry.path, outside, entry.label, entry.matrix)}
        _check_textures(meshes, layers, kind is None)
        for number, entry in enumerate(layers):
            meshes.set_mesh_visibility(number, entry.visible)
        if layer is not None:
            labels = [entry.label for entry in layers]
            if labels.count(layer) != 1:
                raise InputError(f"{project} has {labels.count(layer)} layers called {layer!r}, expected one of "
                                 f"{labels}")
            meshes.set_current_mesh(labels.index(layer))
        if kind is not None:
            file_kinds.check_output(meshes, output, kind, names, any(step.request is not None for step in steps))
        filter_script.run_script(meshes, script, found, outside=outside, device=device,
                                 progress=shown_progress(quiet), names=names)
        if not meshes.mesh_number():
            raise InputError(f"{script} leaves no layer that could be written: its steps delete all of them")
        _save(meshes, output, found)
        if save_script is not None:
            write_text(save_script, history.history_text(meshes))
    log.info("current layer: %s, %d vertices, %d faces", meshes.current_mesh().label(),
             meshes.current_mesh().vertex_number(), meshes.current_mesh().face_number())


def _sources(mesh, project, scene, flavour, outside) -> tuple[list[MeshLayer], object]:
    """The layers to load, and the scene, given with a mesh or the project's own, or None."""
    if mesh is not None:
        return [MeshLayer("", mesh, np.eye(4))], scene
    read = read_project(project, outside=outside)
    layers = [entry for entry in read.meshes if entry.path is not None]
    if not layers:
        raise InputError(f"{project} has no mesh layer with a file")
    if not read.rasters:
        return layers, scene
    if scene is not None:
        raise InputError(f"got SCENE and {project}, which brings its own photos: give one of them")
    if flavour is None:
        flavour, reason = resolve_flavour(read)
        log.info("%s", reason)
    return layers, read.scene(flavour)


def _places(output: Path, save_script: Path | None, found) -> Places:
    """All that may be written: next to a project its layers, too."""
    if output.suffix.lower() != ".mlp":
        return [("--output", output), ("--save-script", save_script)]
    if found is not None:
        check_names(found.views)
    there = sorted(output.parent.glob(f"{glob.escape(output.stem)}_[0-9]*.ply"))
    return [("--output", output), ("--save-script", save_script),
            *((f"--output {str(output)!r} may replace a layer of an earlier one:", file) for file in there)]


def _check_textures(meshes, layers: list[MeshLayer], as_project: bool) -> None:
    """Before the work: InputError where textures have no place of their own next to the output."""
    files: dict[str, Path] = {}
    for mesh, layer in zip(meshes, layers):
        for name in mesh.textures():
            first = files.setdefault(name, file := layer.path.parent / name)
            if ".." in Path(name).parts:        # pymeshlab would write over whatever has that name there
                raise InputError(f"{layer.path} has the texture {name!r} out of its folder, which pymeshlab would "
                                 "write anew: put the texture next to the mesh")
            if as_project and first != file and file.is_file() and not same_pixels(first, file):
                raise InputError(f"{first} and {file} would be one file next to the project of --output: give "
                                 f"one of them another name, in the materials of {layer.path} too")


def _save(meshes, output: Path, scene) -> None:
    """The current layer, or all layers as a project, under the final names when all of them are written."""
    if output.suffix.lower() != ".mlp":
        with replaced_with_others(output.absolute()) as place:
            write_file(meshes, place, output.absolute().parent)
        if not np.array_equal((layer := meshes.current_mesh()).transform_matrix(), np.eye(4)):
            log.warning("%s has the coordinates of the layer %r without its matrix: a .mlp has both, MeshLab's filter "
                        "'Matrix: Freeze Current Matrix' applies it", output, layer.label())
        return
    paths = [output.with_name(f"{output.stem}_{number}.ply") for number in range(meshes.mesh_number())]
    layers, current = [], meshes.current_mesh_id()
    with ExitStack() as stack:      # none gets its name before all are written
        places = [stack.enter_context(replaced_with_others(path.absolute())) for path in paths]
        for mesh, path, place in zip(list(meshes), paths, places):      # their ids have gaps where some were deleted
            meshes.set_current_mesh(mesh.id())
            write_file(meshes, place, output.absolute().parent)
            layers.append(MeshLayer(mesh.label(), path, mesh.transform_matrix(), mesh.is_visible()))
    meshes.set_current_mesh(current)
    write_project(output, [] if scene is None else scene.views, layers)


@contextmanager
def _meshlab_chatter(quiet: bool):
    """Send what pymeshlab's C++ part prints on standard output to standard error, or, where `quiet`, nowhere."""
    sys.stdout.flush()
    kept = os.dup(1)
    try:
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno() if quiet else 2, 1)
        yield
    finally:
        sys.stdout.flush()
        os.dup2(kept, 1)
        os.close(kept)
