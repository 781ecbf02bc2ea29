"""The package as it is shipped: what a wheel holds, what an import loads, who may import whom, and names."""

import ast
import shutil
import subprocess
import sys
import zipfile
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parent.parent
SOURCES = {"pagas_cl": ROOT / "pagas_cl", "pagas_cl/cl_kernels": ROOT / "cl_kernels",
           "pagas_cl/filters": ROOT / "filters"}
SHIPPED = {".py", ".cl", ".clh", ".mlx", ".typed", ".css", ".js", ".npz"}
OPTIONAL = {"open3d", "pymeshlab", "pycolmap", "matplotlib", "skimage", "scipy", "dask", "distributed"}

# Rooms that know nothing of OpenCL.
WITHOUT_OPENCL = ("errors", "config", "progress", "system", "scene", "app.report", "app.evaluate",
                  "result")
# Kernel files that belong to a stage, and a twin, of another name.
STAGE = {"alpha": "composite", "backward": "composite", "deviation": "evidence", "image_noise": "measure",
         "means": "project", "patches": "evidence", "ssim": "loss", "summary": "measure"}
TWINS = ("pagas_cl/method/surface", "tests/twins")


def shipped_files():
    """Every file that belongs into the wheel, as the wheel names it."""
    return {f"{prefix}/{path.relative_to(folder).as_posix()}" for prefix, folder in SOURCES.items()
            for path in folder.rglob("*") if path.suffix in SHIPPED and "__pycache__" not in path.parts}


@cache
def modules() -> list[tuple]:
    """(name without "pagas_cl.", path, syntax tree) of every module of pagas_cl."""
    return [(name_of(path).removeprefix("pagas_cl").lstrip("."), path, ast.parse(path.read_text()))
            for path in sorted(SOURCES["pagas_cl"].rglob("*.py"))]


def imported(tree):
    """Full names that the statements of `tree` import."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are written in full"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def imported_at_once(tree):
    """As `imported`, of the statements that run when the module is imported."""
    later = (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)
    waiting = [tree]
    while waiting:
        node = waiting.pop()
        if isinstance(node, (ast.Import, ast.ImportFrom)):
            yield from imported(ast.Module([node], []))
        waiting += [child for child in ast.iter_child_nodes(node) if not isinstance(child, later)]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """A wheel built from a copy of the tree, so that nothing is left behind in it."""
    tree, out = tmp_path_factory.mktemp("tree"), tmp_path_factory.mktemp("wheel")
    for name in ("pagas_cl", "cl_kernels", "filters"):
        shutil.copytree(ROOT / name, tree / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, tree)
    done = subprocess.run([sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(out), str(tree)],
                          capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return next(out.glob("*.whl"))


@pytest.mark.slow
def test_wheel_holds_every_source_kernel_and_filter_and_nothing_else(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    code = {name for name in names if ".dist-info/" not in name}
    assert code == shipped_files()
    assert any(name.endswith(".cl") for name in code) and any(name.endswith(".clh") for name in code)
    assert any(name.endswith("LICENSE") for name in names - code)


@pytest.mark.slow
def test_kernels_are_read_from_a_zipped_wheel(wheel, tmp_path):
    program = """
import sys
sys.path.insert(0, sys.argv[1])
import pagas_cl
from importlib.resources import files
from pagas_cl.runtime.program import source
assert pagas_cl.__file__.startswith(sys.argv[1]), pagas_cl.__file__
kernels = [f.name for f in files("pagas_cl.cl_kernels").iterdir() if f.name.endswith(".cl")]
assert kernels and all("__kernel" in source(name) for name in kernels)
"""
    done = subprocess.run([sys.executable, "-c", program, str(wheel)], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_every_package_is_listed():
    tomllib = pytest.importorskip("tomllib")  # Python 3.11
    listed = set(tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"])
    there = {str(path.parent.relative_to(ROOT)).replace("/", ".") for path in SOURCES["pagas_cl"].rglob("__init__.py")}
    assert listed == there | {"pagas_cl.cl_kernels", "pagas_cl.filters"}


def test_integers_have_64_bits_on_windows():
    """NumPy's own, of a list or a sum: before NumPy 2 they have 32 there."""
    tomllib = pytest.importorskip("tomllib")  # Python 3.11
    needed = map(Requirement, tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"])
    there = [one.specifier for one in needed if one.name == "numpy"
             and (one.marker is None or one.marker.evaluate({"sys_platform": "win32"}))]
    assert there and not all("1.26.4" in allowed for allowed in there)


def test_importing_the_package_loads_nothing_heavy():
    program = """
import sys
import pagas_cl
dir(pagas_cl); pagas_cl.Camera; pagas_cl.InputError; pagas_cl.Config
heavy = {"pyopencl", "open3d", "pymeshlab", "pycolmap", "matplotlib", "scipy", "skimage", "typer"} & set(sys.modules)
assert not heavy, heavy
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_every_public_name_is_there():
    import pagas_cl

    for name in pagas_cl.__all__:
        assert getattr(pagas_cl, name).__name__ == name
    with pytest.raises(AttributeError, match="no attribute 'refine_mash'"):
        pagas_cl.refine_mash


def test_imports_go_down_and_the_picture_shows_them():
    """The floors are those of docs/draw_architecture.py; no module is in a circle of imports either."""
    done = subprocess.run([sys.executable, ROOT / "docs" / "draw_architecture.py", "--check"], capture_output=True,
                          text=True)
    assert done.returncode == 0, done.stderr
    graph = {name: {full if full in known else full.rpartition(".")[0] for full in imported(tree)}
             for known in [{name_of(path) for _, path, _ in modules()}] for _, path, tree in modules()
             for name in [name_of(path)]}
    TopologicalSorter({name: (used & graph.keys()) - {name} for name, used in graph.items()}).prepare()


def name_of(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def test_optional_packages_and_opencl_are_imported_late():
    for name, path, tree in modules():
        tops = {full.split(".")[0] for full in imported_at_once(tree)}
        assert not tops & OPTIONAL, f"{path} imports {tops & OPTIONAL} when it is imported"
        if name.startswith(WITHOUT_OPENCL):
            assert "pyopencl" not in {full.split(".")[0] for full in imported(tree)}, path


def test_library_keeps_its_habits():
    for _, path, tree in modules():
        for node in ast.walk(tree):
            where = f"{path}:{getattr(node, 'lineno', 0)}"
            assert not isinstance(node, ast.Assert), f"{where}: assert in the library"
            assert not (isinstance(node, ast.ExceptHandler) and node.type is None), f"{where}: bare except"
            called = getattr(getattr(node, "func", None), "id", "")
            assert called != "print", f"{where}: print in the library"


def test_kernels_stages_and_twins_have_the_same_names():
    files = {path.stem for path in SOURCES["pagas_cl/cl_kernels"].glob("*.cl")}
    for kernel in sorted(files - {"common"}):       # which has no kernel of its own
        stage = STAGE.get(kernel, kernel)
        launchers = [path for path in (ROOT / "pagas_cl" / "method" / room / f"{stage}.py"
                                       for room in ("splat", "surface", "cameras", "view")) if path.is_file()]
        assert any(f'"{kernel}.cl"' in path.read_text() for path in launchers), f"nothing launches {kernel}.cl"
        assert any((ROOT / place / f"{stage}.py").is_file() for place in TWINS), f"{kernel}.cl has no twin"


def test_kernels_use_no_double_and_no_vendor_extension():
    for path in SOURCES["pagas_cl/cl_kernels"].glob("*.cl*"):
        code = "\n".join(line.partition("//")[0] for line in path.read_text().splitlines())
        for word in ("double", "cl_khr_fp64", "cl_nv", "cl_amd", "cl_intel"):
            assert word not in code, f"{path.name} uses {word}"
