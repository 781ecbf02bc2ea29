"""The records of a study, in a file that is whole at any time: an interrupted study goes on where it ended."""

from __future__ import annotations

import json
import logging
import os
from dataclasses import asdict
from pathlib import Path

import numpy as np

from pagas_cl.errors import InputError
from pagas_cl.tradeoffs.case import BenchmarkCase
from pagas_cl.tradeoffs.plan import Setting

log = logging.getLogger("pagas_cl")

FILE = "tradeoff.json"


class Book:
    """Records of runs on one device.

    Parameters
    ----------
    folder : Path or None
        Where tradeoff.json is or will be; None keeps the records in memory.
    device : str
        Records of another device are not taken up.
    """

    def __init__(self, folder: Path | None, device: str):
        self.path = None if folder is None else folder / FILE
        self.device, self.records = device, []
        if self.path is not None and self.path.is_file():
            try:
                kept = json.loads(self.path.read_text())
                self.records = list(kept["records"]) if kept["device"] == device else []
            except (ValueError, KeyError, TypeError) as error:
                raise InputError(f"{str(self.path)!r} is no record of a study ({error}); move it away") from error
            log.info("%s: %d runs are there already", self.path, len(self.records))

    def has(self, setting: Setting, case: BenchmarkCase) -> bool:
        return any(r["key"] == setting.key and r["case"] == case.name
                   and r.get("pixels", case.pixels) == case.pixels for r in self.records)

    def add(self, record: dict):
        self.records.append(record)
        if self.path is not None:
            self.write({"device": self.device, "records": self.records})

    def as_dict(self, study) -> dict:
        """Everything for tradeoff.json."""
        return json_ready({"device": self.device, "figure": study.figure, "proxy_rank_correlation": study.proxy,
                      "initial": study.initial, "left_out": study.left_out,
                      "points": [asdict(point) for point in study.points], "records": self.records})

    def write(self, content: dict):
        """Write the file beside itself and rename it."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        beside = self.path.with_name(f".{FILE}.{os.getpid()}.part")
        beside.write_text(json.dumps(json_ready(content), indent=1))
        os.replace(beside, self.path)


def json_ready(value):
    """`value` with null for numbers that JSON does not have."""
    if isinstance(value, dict):
        return {key: json_ready(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [json_ready(item) for item in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
