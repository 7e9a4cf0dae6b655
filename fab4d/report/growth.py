"""How time and memory grow with the number of tets: laws fitted to finished runs, and what they say of one run."""

from collections.abc import Mapping, Sequence
from typing import Any

# Fitted to the seven samples (240 to 14,400 tets) on two cores with little else to do. All but the largest sample are
# finished in quadratic tets, so that the laws are rough.
# Stage: seconds at 1,000 tets, and the power of the number of tets with which they grow.
# A power below zero, noise of the runs, is taken as zero.
STAGE_SECONDS: Mapping[str, tuple[float, float]] = {
    "check": (0.859, 0.0),
    "solve": (8.38, 0.96),
    "threshold": (0.0313, 0.70),
    "refit": (12.5, 0.20),
    "verify": (0.819, 0.17),
    "sensitivity": (0.977, 1.03),
    "judge": (0.00956, 0.32),
    "bodies": (0.446, 0.13),
    "slice": (0.761, 0.53),
    "rig": (0.214, 0.10),
    "report": (0.254, 0.11),
}
# Peak memory: MB of the program itself, and MB for each 1,000 tets.
MEMORY_MB = (1284, 50.4)
# What a run on a mesh of so many times the tets would take is told in its report.
FINER = (2, 8)


def stage_seconds(stage: str, n_tets: int) -> float:
    """Seconds that a stage takes: s * (n_tets / 1000) ** p."""
    seconds, power = STAGE_SECONDS[stage]
    return seconds * (n_tets / 1000) ** power


def peak_mb(n_tets: int) -> float:
    """Peak memory of a run, MB: base + slope * n_tets / 1000."""
    base, slope = MEMORY_MB
    return base + slope * n_tets / 1000


def growth(n_tets: int, stages: Sequence[Mapping[str, Any]], peak_rss_mb: float | None) -> dict[str, Any]:
    """The powers with which the time of a finished run's `stages` grows, and what finer meshes would take by them.

    stages : name and wall_s of each        peak_rss_mb : of the run, None where the system does not tell
    """

    def finer(factor: int) -> dict[str, Any]:
        seconds = sum(stage["wall_s"] * factor ** STAGE_SECONDS[stage["name"]][1] for stage in stages)
        more = peak_mb(factor * n_tets) - peak_mb(n_tets)
        return {
            "tets": factor * n_tets,
            "wall_s": seconds,
            "peak_rss_mb": None if peak_rss_mb is None else peak_rss_mb + more,
        }

    powers = {stage["name"]: STAGE_SECONDS[stage["name"]][1] for stage in stages}
    return {"tets": n_tets, "powers": powers, "finer": [finer(factor) for factor in FINER]}
