"""Expected time and memory: laws fitted to runs of a known law give it back."""

from pathlib import Path

import numpy as np
import pytest

from fab4d.report.growth import MEMORY_MB, STAGE_SECONDS, growth, peak_mb, stage_seconds
from fab4d.runner.outlook import fit_lines, measured, power_law, straight_line
from fab4d.runner.table import stage_table
from fab4d.runner.workspace import Workspace

SIZES = [240, 1705, 14400]


def test_every_stage_has_a_law() -> None:
    assert tuple(STAGE_SECONDS) == stage_table().names


def test_expectations_grow_with_the_mesh() -> None:
    for name in stage_table().names:
        assert 0 < stage_seconds(name, 1000) <= stage_seconds(name, 50000)
    assert 50 < peak_mb(1000) < peak_mb(190000) < 20000


def test_fits_give_known_laws_back() -> None:
    assert power_law(SIZES, [3.0 * (n / 1000) ** 1.4 for n in SIZES]) == pytest.approx((3.0, 1.4))
    assert straight_line(SIZES, [200 + 12.0 * n / 1000 for n in SIZES]) == pytest.approx((200, 12.0))


def test_a_finer_mesh_takes_what_the_laws_say_of_a_run_that_followed_them() -> None:
    n, names = 1500, stage_table().names[:4]
    stages = [{"name": name, "wall_s": 3 * stage_seconds(name, n)} for name in names]
    told = growth(n, stages, peak_mb(n) + 50)
    assert told["tets"] == n
    assert told["powers"] == {name: STAGE_SECONDS[name][1] for name in names}
    for factor, finer in zip((2, 8), told["finer"], strict=True):
        assert finer["tets"] == factor * n
        assert finer["wall_s"] == pytest.approx(3 * sum(stage_seconds(name, factor * n) for name in names))
        assert finer["peak_rss_mb"] == pytest.approx(peak_mb(factor * n) + 50)
    assert growth(n, stages, None)["finer"][1]["peak_rss_mb"] is None
    assert told["finer"][1]["peak_rss_mb"] - told["finer"][0]["peak_rss_mb"] == pytest.approx(
        6 * n * MEMORY_MB[1] / 1000
    )


def finished_run(root: Path, n_tets: int) -> None:
    """A run folder whose stages took 2 s a 1,000 tets, in 100 MB and 10 MB a 1,000 tets."""
    workspace = Workspace(root, stage_table().artifacts)
    workspace.save({"mesh": {"tets": np.zeros((n_tets, 4), int)}})
    for name in stage_table().names:
        workspace.save_manifest(name, {"wall_s": n_tets / 500, "peak_rss_mb": 100 + n_tets / 100})


def test_the_constants_are_read_off_finished_runs(tmp_path: Path) -> None:
    for n in SIZES:
        finished_run(tmp_path / str(n), n)
    Workspace(tmp_path / str(SIZES[0]), stage_table().artifacts).remove_manifest("judge")
    lines = fit_lines(measured(tmp_path / str(n)) for n in SIZES)
    assert [int(line.split()[0]) for line in lines[1:4]] == SIZES
    assert '    "solve": (2, 1.00),' in lines
    assert '    "judge": (2, 1.00),' in lines
    assert lines[-1] == "MEMORY_MB = (100, 10)"
