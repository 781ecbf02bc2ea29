"""Optional packages that are absent, or there and not to be loaded: which it is, and what to do."""

import copy
import importlib
import pickle
import re
import subprocess
import sys

import pytest
from conftest import ROOT

from pagas_cl.errors import InputError, KernelBuildError, MissingExtraError, UnloadableError, need


@pytest.mark.parametrize("cause, message", [
    (ImportError("libX11.so.6: cannot open shared object file: No such file or directory"), "apt-get install"),
    (ImportError("libmkl.so: failed to map segment from shared object"), "raise the limit .ulimit -v"),
    (OSError("libtbb.so: cannot allocate memory in static TLS block"), "raise the limit"),
    (MemoryError(), "MemoryError.*raise the limit"), (ImportError("DLL load failed"), "--force-reinstall"),
    (ModuleNotFoundError("No module named 'dash'", name="dash"), "a package that it needs is absent")])
def test_a_package_that_cannot_be_loaded(monkeypatch, cause, message):
    def fails(name):
        raise cause

    monkeypatch.setattr("pagas_cl.errors.import_module", fails)
    with pytest.raises(UnloadableError, match=f"fusing needs open3d, which is installed and cannot be load.*{message}"):
        need("open3d", "mesh", "fusing")


def test_a_package_that_is_absent(monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(MissingExtraError, match=r'not installed: pip install "pagas-cl\[mesh\]"'):
        need("open3d", "mesh", "fusing")


@pytest.mark.parametrize("error", [MissingExtraError("open3d", "mesh", "fusing"), InputError("a photo"),
                                   UnloadableError("open3d", "fusing", ImportError("No module named 'x'")),
                                   KernelBuildError("no", "log", "-D A", "source")])
def test_errors_come_back_from_other_processes(error):
    """Where one could not be unpickled a ProcessPoolExecutor broke, and a multiprocessing.Pool waited for ever."""
    for again in (pickle.loads(pickle.dumps(error)), copy.deepcopy(error)):
        assert type(again) is type(error) and str(again) == str(error) and vars(again) == vars(error)


def test_every_extra_that_is_named_exists():
    known = set(re.findall(r"^(\w+) = \[", (ROOT / "pyproject.toml").read_text(), re.M))
    for path in [*(ROOT / "pagas_cl").rglob("*.py"), *(ROOT / "filters").rglob("*.py")]:
        for package, extra in re.findall(r'need\("(\w+)", "(\w+)"', path.read_text()):
            assert extra in known, f"{path} names the extra {extra!r} for {package}"


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="limits of Linux")
@pytest.mark.parametrize("package", ["open3d", "pymeshlab", "pycolmap"])
def test_little_memory_is_said_to_be_that(package):
    """`ulimit -v`: the loader of the system finds no room for the package's code."""
    if importlib.util.find_spec(package) is None:
        pytest.skip(f"{package} is not installed")
    code = ("import resource, numpy\nfrom pagas_cl.errors import UnloadableError, need\n"
            "used = int(open('/proc/self/statm').read().split()[0]) * resource.getpagesize()\n"
            "resource.setrlimit(resource.RLIMIT_AS, (used + (2 << 20),) * 2)\n"
            f"try:\n    need('{package}', 'mesh', 'this')\n"
            "except UnloadableError as error:\n    print(error)\n")
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=100)
    assert "cannot be loaded" in ended.stdout and "raise the limit" in ended.stdout, ended.stdout + ended.stderr
