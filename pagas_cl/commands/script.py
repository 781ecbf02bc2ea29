"""`pagas-cl script`: a MeshLab filter script (.mlx) with our step in it, without MeshLab's window or OpenGL."""

import glob
import os
import sys
import tempfile
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import typer

from pagas_cl.commands._console import nothing_refined, shown_progress
from pagas_cl.commands._start import check_source, check_writable, load_scene
from pagas_cl.errors import InputError, log, need
from pagas_cl.filters import filter_script
from pagas_cl.scene.files import is_file, read_bytes, replaced_with_others
from pagas_cl.scene.mesh_file import check_mesh_file
from pagas_cl.scene.readers.meshlab import MeshLayer, check_names, read_project, settle_flavour, write_project


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
    format: str = typer.Option(None, "--format", help="Format of SCENE, where looking at it is not enough."),
    device: str = typer.Option(None, "--device", help="Part of an OpenCL device's name; see 'pagas-cl devices'."),
    outside: bool = typer.Option(False, "--outside", help="Allow files outside the folders (files that you trust)."),
    quiet: bool = typer.Option(False, "--quiet", help="No progress."),
):
    """Run SCRIPT on a mesh, or on a MeshLab project; the whole script is checked before anything runs."""
    pymeshlab = need("pymeshlab", "meshlab", "running a filter script")
    check_source(mesh, project, "what the script starts from", outside, "--project")
    if mesh is None and scene is not None:
        raise InputError("got SCENE and --project: a project brings its own photos; give one of them")
    filter_script.check_script(script, outside=outside)
    for option, path in (("--output", output), ("--save-script", save_script)):
        check_writable(option, path and path.parent)
    _check_kind(pymeshlab, output)
    _check_layers(output)
    with _meshlab_chatter():
        meshes, found = _start(pymeshlab, mesh, project, layer, scene, format, flavour, outside)
        if found is not None and output.suffix.lower() == ".mlp":
            check_names(found.views)
        with shown_progress(quiet) as progress:
            filter_script.run_script(meshes, script, found, outside=outside, device=device, progress=progress)
        _save(meshes, output, found)
        if save_script is not None:
            meshes.save_filter_script(str(save_script.absolute()))
    log.info("current layer: %s, %d vertices, %d faces", meshes.current_mesh().label(),
             meshes.current_mesh().vertex_number(), meshes.current_mesh().face_number())


def _check_kind(pymeshlab, output: Path) -> None:
    """Raise InputError for a kind of file that pymeshlab cannot write, which it tells only when it has to."""
    if output.suffix.lower() == ".mlp":
        return
    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]))
    with tempfile.TemporaryDirectory() as scratch, _meshlab_chatter():
        try:
            meshes.save_current_mesh(str(Path(scratch) / f"a{output.suffix}"))
        except pymeshlab.PyMeshLabException as error:
            raise InputError(f"--output {str(output)!r}: pymeshlab writes no {output.suffix!r} files, expected .ply, "
                             ".obj, .stl, .off, ... or .mlp") from error


def _check_layers(output: Path) -> None:
    """Raise InputError where a project's layers would replace files that are not those of the project there now."""
    if output.suffix.lower() != ".mlp":
        return
    known = read_bytes(output).decode("utf-8", "replace") if is_file(output) else ""
    for file in sorted(output.parent.glob(f"{glob.escape(output.stem)}_[0-9]*.ply")):
        if file.name not in known:
            raise InputError(f"--output {str(output)!r}: its layers may replace {str(file)!r}, which is not one of its "
                             "layers now; choose another name or folder")


def _start(pymeshlab, mesh, project, layer, scene, format, flavour, outside):
    """The MeshSet to start from, and the scene or None."""
    meshes = pymeshlab.MeshSet()
    if mesh is not None:
        load_layer(pymeshlab, meshes, mesh, outside)
        return meshes, None if scene is None else load_scene(scene, format, outside)
    read = read_project(project, outside=outside)
    layers = [entry for entry in read.meshes if entry.path is not None]
    if not layers:
        raise InputError(f"{project} has no mesh layer with a file")
    for entry in layers:
        load_layer(pymeshlab, meshes, entry.path, outside, entry.label, entry.matrix)
    labels = [entry.label for entry in layers]
    if layer is not None:
        if labels.count(layer) != 1:
            raise InputError(f"{project} has {labels.count(layer)} layers called {layer!r}, expected one of {labels}")
        meshes.set_current_mesh(labels.index(layer))
    if not read.rasters:
        return meshes, None
    if flavour is None:
        flavour, reason = settle_flavour(read)
        log.info("%s", reason)
    return meshes, read.scene(flavour)


def load_layer(pymeshlab, meshes, path: Path, outside: bool, label: str | None = None, matrix=None) -> None:
    """A mesh file as a new layer, which becomes the current one; its matrix keeps all its digits."""
    check_mesh_file(path, outside=outside)
    try:
        meshes.load_new_mesh(str(Path(path).absolute()))
    except (pymeshlab.PyMeshLabException, RuntimeError) as error:
        raise InputError(f"mesh {str(path)!r} cannot be read: {' '.join(str(error).split())[:200]}") from error
    if label:
        meshes.current_mesh().set_label(label)
    if matrix is not None and not np.array_equal(matrix, np.eye(4)):
        meshes.set_matrix(transformmatrix=np.asarray(matrix, np.float64), freeze=False)
    meshes.clear_filter_script()  # loading is no step of the script


def _save(meshes, output: Path, scene) -> None:
    """The current layer, or all layers as a project, under the final names at once."""
    if output.suffix.lower() != ".mlp":
        save_layer(meshes, output)
        return
    layers, current = [], meshes.current_mesh_id()
    for number in range(meshes.mesh_number()):
        mesh, path = meshes.mesh(number), output.with_name(f"{output.stem}_{number}.ply")
        meshes.set_current_mesh(mesh.id())
        save_layer(meshes, path)
        layers.append(MeshLayer(mesh.label(), path, mesh.transform_matrix(), mesh.is_visible()))
    meshes.set_current_mesh(current)
    write_project(output, [] if scene is None else scene.views, layers)


def save_layer(meshes, path: Path) -> None:
    """The current layer beside `path` first, then renamed; the file holds the layer's own coordinates."""
    with replaced_with_others(path.absolute()) as beside:
        meshes.save_current_mesh(str(beside))
        if not beside.is_file():
            raise InputError(f"pymeshlab did not write {str(path)!r}: is {path.suffix!r} a kind of mesh file?")


@contextmanager
def _meshlab_chatter():
    """Send what pymeshlab's C++ part prints on standard output to standard error."""
    sys.stdout.flush()
    kept = os.dup(1)
    try:
        os.dup2(2, 1)
        yield
    finally:
        sys.stdout.flush()
        os.dup2(kept, 1)
        os.close(kept)
