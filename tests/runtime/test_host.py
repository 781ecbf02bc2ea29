"""Memory of the host."""

import ctypes
import sys
from pathlib import Path
from unittest.mock import Mock

from pagas_cl.runtime.host import available_mb


def test_free_memory_on_other_systems(monkeypatch):
    def status(filled):
        assert bytes(filled)[:4] == (64).to_bytes(4, "little")      # as the struct MEMORYSTATUSEX begins
        filled[1:3] = 16_000_000_000, 3_000_000_000

    monkeypatch.setattr(Path, "read_text", Mock(side_effect=FileNotFoundError))      # no /proc
    assert 100 < available_mb() < 1e8
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setattr(ctypes, "windll", Mock(**{"kernel32.GlobalMemoryStatusEx": status}), raising=False)
    assert available_mb() == 3000
