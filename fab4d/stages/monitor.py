"""How a running stage reports progress and keeps what it has, without knowing terminals or files."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np


class Monitor(Protocol):
    """What a stage may ask of whoever runs it."""

    def progress(self, phase: str, **values: float) -> None:
        """Tell the phase and figures such as rms_mm, forces, smp_fraction, tau."""

    def save(self, name: str, arrays: Mapping[str, np.ndarray]) -> None:
        """Keep `arrays` until this stage is done, so that a killed run can go on from here."""

    def restore(self, name: str) -> dict[str, np.ndarray] | None:
        """What an earlier, unfinished run of the same stage on the same inputs saved, or None."""


class SilentMonitor:
    """A monitor that tells nobody and keeps nothing."""

    def progress(self, phase: str, **values: float) -> None:
        pass

    def save(self, name: str, arrays: Mapping[str, np.ndarray]) -> None:
        pass

    def restore(self, name: str) -> dict[str, np.ndarray] | None:  # noqa: ARG002
        return None


@dataclass(frozen=True)
class Prefixed:
    """The monitor of a part of a stage: the names of what it keeps begin with `prefix`."""

    monitor: Monitor
    prefix: str

    def progress(self, phase: str, **values: float) -> None:
        self.monitor.progress(phase, **values)

    def save(self, name: str, arrays: Mapping[str, np.ndarray]) -> None:
        self.monitor.save(self.prefix + name, arrays)

    def restore(self, name: str) -> dict[str, np.ndarray] | None:
        return self.monitor.restore(self.prefix + name)
