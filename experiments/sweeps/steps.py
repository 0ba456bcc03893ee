"""How far the parts of an experiment are, from the lines they write while they run."""

from __future__ import annotations

import collections
import json
import pathlib


class StepCounter:
    """Optimiser steps that each part of a working folder has behind it."""

    def __init__(self, workdir: pathlib.Path, steps_per_round: int):
        self._path, self._steps_per_round = workdir / "metrics.jsonl", steps_per_round
        self._offset = 0
        self._steps = collections.Counter()

    def read(self) -> dict[str, int]:
        """Steps by name of the part, round 0 included; reads only what is new since last time."""
        if not self._path.exists():
            return self._steps
        with open(self._path, "rb") as file:
            file.seek(self._offset)
            text = file.read()
        end = text.rfind(b"\n") + 1
        self._offset += end
        for line in text[:end].splitlines():
            try:
                event = json.loads(line)
            except ValueError:  # what was being written when a process was killed
                continue
            rounds = event["round"] + (event["event"] == "round")
            steps = rounds * self._steps_per_round + event.get("step", 0)
            part = f"{event['policy']}/seed_{event['seed']}"
            # A part that was killed goes back to its checkpoint, which is no progress.
            self._steps[part] = max(self._steps[part], steps)
        return self._steps
