"""One updating line on a terminal, few lines in a log."""

import io

import pytest

from fab4d.runner.display import TerminalDisplay, duration, progress_text


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_log_gets_a_line_for_each_phase_and_then_one_now_and_then() -> None:
    stream, now = io.StringIO(), [0.0]
    display = TerminalDisplay(stream, lambda: now[0])
    for now[0] in (0.0, 1.0, 9.0, 10.5, 11.0):
        display.progress("solve", "hold all", {"rms_mm": now[0]}, now[0])
    display.progress("solve", "release", {}, 11.0)
    assert stream.getvalue().splitlines() == [
        "solve      hold all  RMS 0 mm  0.0 s",
        "solve      hold all  RMS 10.5 mm  10.5 s",
        "solve      release  11.0 s",
    ]


def test_a_terminal_gets_one_line_that_is_overwritten_whole() -> None:
    stream, now = Terminal(), [0.0]
    display = TerminalDisplay(stream, lambda: now[0])
    display.progress("solve", "a long name of a phase", {}, 0.0)
    now[0] = 1.0
    display.progress("solve", "short", {}, 1.0)
    display.note("solve", "done")
    shown = stream.getvalue().split("\r")[1:]
    assert len(shown) == 3
    assert len(shown[1]) >= len(shown[0].rstrip())
    assert [text.endswith("\n") for text in shown] == [False, False, True]


def test_progress_tells_phase_figures_and_time() -> None:
    values = {"rms_mm": 1.234, "forces": 8.0, "smp_fraction": 0.456, "tau": 812.3, "beta": 4.0}
    assert progress_text("finish", values, 75.0) == (
        "finish  RMS 1.23 mm  8 forces  SMP 45.6 %  812 tau  beta 4  1 min 15 s"
    )


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.04, "0.0 s"), (59.9, "59.9 s"), (185.0, "3 min 05 s"), (7800.0, "2 h 10 min")]
)
def test_duration(seconds: float, text: str) -> None:
    assert duration(seconds) == text
