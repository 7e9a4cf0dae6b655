"""The Monitor that a running stage is given."""

import time
from collections.abc import Mapping

import numpy as np

from fab4d.runner.display import Display
from fab4d.runner.workspace import Checkpoints


class StageMonitor:
    """Shows the progress of one stage and keeps its checkpoints."""

    def __init__(self, stage: str, checkpoints: Checkpoints, display: Display) -> None:
        self._stage, self._checkpoints, self._display = stage, checkpoints, display
        self._start = time.perf_counter() - checkpoints.spent_s

    def elapsed_s(self) -> float:
        """Time that the stage has worked, over all its starts since its inputs changed, s."""
        return time.perf_counter() - self._start

    def progress(self, phase: str, **values: float) -> None:
        self._display.progress(self._stage, phase, values, self.elapsed_s())

    def save(self, name: str, arrays: Mapping[str, np.ndarray]) -> None:
        self._checkpoints.save(name, arrays, self.elapsed_s())

    def restore(self, name: str) -> dict[str, np.ndarray] | None:
        return self._checkpoints.restore(name)
