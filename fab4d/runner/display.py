"""What a person sees while stages run: one updating line on a terminal, a line now and then in a log."""

import shutil
import time
from collections.abc import Callable, Mapping
from typing import Protocol, TextIO

# Seconds between two lines of the same phase: often enough to watch, seldom enough to read a log.
TERMINAL_INTERVAL_S = 0.1
LOG_INTERVAL_S = 10.0

_FORMS: Mapping[str, Callable[[float], str]] = {
    "rms_mm": lambda value: f"RMS {value:.3g} mm",
    "max_mm": lambda value: f"max {value:.3g} mm",
    "forces": lambda value: f"{value:.0f} forces",
    "tets": lambda value: f"{value:.0f} tets",
    "smp_fraction": lambda value: f"SMP {100 * value:.1f} %",
    "tau": lambda value: f"{value:.0f} tau",
}


class Display(Protocol):
    """Whom the runner tells what happens."""

    def note(self, stage: str, text: str) -> None:
        """A line that stays."""

    def progress(self, stage: str, phase: str, values: Mapping[str, float], elapsed_s: float) -> None:
        """A state that the next one replaces."""


class SilentDisplay:
    """Shows nothing."""

    def note(self, stage: str, text: str) -> None:
        pass

    def progress(self, stage: str, phase: str, values: Mapping[str, float], elapsed_s: float) -> None:
        pass


class TerminalDisplay:
    """Writes to `stream`; on a terminal a state overwrites the one before it."""

    def __init__(self, stream: TextIO, clock: Callable[[], float] = time.monotonic) -> None:
        self._stream, self._clock = stream, clock
        self._updates = stream.isatty()
        self._phase: tuple[str, str] | None = None
        self._shown_at = 0.0
        self._width = 0

    def note(self, stage: str, text: str) -> None:
        self._write(f"{stage:<10} {text}", "\n")

    def progress(self, stage: str, phase: str, values: Mapping[str, float], elapsed_s: float) -> None:
        if self._is_due((stage, phase)):
            self._write(f"{stage:<10} {progress_text(phase, values, elapsed_s)}", "" if self._updates else "\n")

    def _is_due(self, phase: tuple[str, str]) -> bool:
        interval = TERMINAL_INTERVAL_S if self._updates else LOG_INTERVAL_S
        now = self._clock()
        if phase == self._phase and now - self._shown_at < interval:
            return False
        self._phase, self._shown_at = phase, now
        return True

    def _write(self, line: str, end: str) -> None:
        if self._updates:
            line = line[: shutil.get_terminal_size().columns - 1]
            self._stream.write("\r" + line.ljust(self._width) + end)
            self._width = 0 if end else len(line)
        else:
            self._stream.write(line + end)
        self._stream.flush()


def progress_text(phase: str, values: Mapping[str, float], elapsed_s: float) -> str:
    """Phase, figures and elapsed time on one line."""
    figures = [_FORMS[name](value) if name in _FORMS else f"{name} {value:g}" for name, value in values.items()]
    return "  ".join([phase, *figures, duration(elapsed_s)])


def duration(seconds: float) -> str:
    """Seconds as a person says them: 4.2 s, 3 min 05 s, 2 h 10 min."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"
