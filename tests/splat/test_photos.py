"""Photos on the device: each is read once, several at a time where the device leaves the host idle."""

from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from support.scenes import relief_scene

from pagas_cl import InputError, preset, refine_mesh
from pagas_cl.method.splat.photos import PhotoStore, photo_bytes, rgba
from pagas_cl.runtime.memory import download
from pagas_cl.scene.camera import Size
from pagas_cl.scene.view import View

pytestmark = pytest.mark.kernels


@pytest.fixture(scope="module")
def made():
    return relief_scene(64, 48, contexts=4, held_out=0, steps=0)


@pytest.fixture
def reads(monkeypatch):
    """How often the photo of each view was read."""
    count, load = Counter(), View.load_image
    monkeypatch.setattr(View, "load_image", lambda view: (count.update([view.name]), load(view))[1])
    return count


def test_several_photos_are_read_at_a_time(made, device, reads):
    views, store, size = made.views, PhotoStore(device), Size(64, 48)
    store.on_host = False                                # as on a GPU
    for _ in range(2):
        buffers, _ = store.level(views, [size] * len(views), None)
    assert set(reads.values()) == {1} and len(reads) == len(views)
    for view, buffer in zip(views, buffers):
        assert np.array_equal(download(device, buffer, (48, 64, 4), np.uint8), rgba(view.load_image(), None))
    moved = [replace(view) for view in views]
    store.replace(views, moved)
    assert all(map(store.has, moved)) and not any(map(store.has, views))


def test_photos_are_read_ahead_while_there_is_room(made, device, reads, monkeypatch):
    views, store = made.views, PhotoStore(device)
    monkeypatch.setattr("pagas_cl.method.splat.photos._AHEAD", photo_bytes(64 * 48))
    with ThreadPoolExecutor(2) as readers:
        for view in [*views, *views]:       # the second one is the first beyond it
            store.read_ahead(view, readers)
    assert list(reads) == [view.name for view in views[:2]]
    for view in views:
        store.photo(view)
    store.read_ahead(views[0], ThreadPoolExecutor(1))      # it is there
    assert set(reads.values()) == {1} and len(reads) == len(views)


def test_a_photo_that_cannot_be_read_raises_where_it_is_needed(made, device, tmp_path):
    store, view = PhotoStore(device), replace(made.views[0], image=tmp_path / "gone.png")
    with ThreadPoolExecutor(1) as readers:
        store.read_ahead(view, readers)
    for _ in range(2):
        with pytest.raises(InputError, match="gone.png"):
            store.photo(view)


def test_a_photo_is_read_once_from_mesh_to_mesh(made, device, reads):
    config = preset("fast").with_settings(pyramid__steps=(5,), effects__cameras="auto")
    refine_mesh(made.initial_mesh(), made.cameras, [view.image for view in made.views], config=config, device=device,
                output="mesh")
    assert set(reads.values()) == {1}
