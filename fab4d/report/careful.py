"""What must be done carefully: the words for sensitivity_report."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeGuard

from fab4d.report.wording import number, significant

JUMPS = "jumps away"
HARDLY_STABLE = (
    "HARDLY STABLE: pads a little off make the part jump to another shape. Best redesign it, with more points, say."
)
DO_NOT_HANG_WEIGHTS = (
    "HOLD POSITIONS, DO NOT HANG WEIGHTS: under forces that do not change as the part moves, this shape is unstable."
)
# Where less of its stiffness is left, what a printer and a rig do a little otherwise than planned may be enough.
NEARLY_BUCKLED = 0.1
PHASES = {"tpe": "TPE", "rubbery": "hot SMP", "glassy": "cold SMP"}


@dataclass(frozen=True)
class Deviation:
    """Something that is not as designed, and the RMS error, mm, that the finished shape then has.

    rms : None where the part has no such shape near the designed one, and jumps to another
    model : by the model of second order about the designed positions, None where it has nothing to say
    """

    what: str
    rms: float | None
    model: float | None = None

    @property
    def rank(self) -> float:
        """The larger, the more care."""
        return float("inf") if self.rms is None else self.rms

    @property
    def words(self) -> str:
        """The error as printed."""
        return JUMPS if self.rms is None else significant(self.rms)


def is_measured(sensitivity: Mapping[str, Any] | None) -> TypeGuard[Mapping[str, Any]]:
    """Whether the report tells how the error moves."""
    return sensitivity is not None and "rms_mm" in sensitivity


def worst_deviations(sensitivity: Mapping[str, Any]) -> list[Deviation]:
    """The worst deviation of each kind, worst first."""
    worst = [max(kind, key=lambda d: d.rank) for kind in deviations(sensitivity)]
    return sorted(worst, key=lambda d: -d.rank)


def deviations(sensitivity: Mapping[str, Any]) -> list[list[Deviation]]:
    """All deviations by kind: all pads together, each pad alone, all forces, and the moduli of each phase."""
    hold = sensitivity["hold"]
    size = f"{hold['change_mm']:g} mm off"
    together = Deviation(
        f"every pad {size}, each in a random direction", hold["random_rms_mm"], hold["random_model_rms_mm"]
    )
    alone = [
        Deviation(f"pad {p['point']} alone {size}, towards ({_direction(p['direction'])})", error, p["model_rms_mm"])
        for p, error in zip(hold["points"], point_errors(sensitivity), strict=True)
    ]
    moduli = [_modulus_deviations(sensitivity["modulus"], phase) for phase in PHASES]
    return [[together], alone, _force_deviations(sensitivity["force"]), *moduli]


def point_errors(sensitivity: Mapping[str, Any]) -> list[float | None]:
    """RMS error, mm, with each pad alone off in its worst direction: simulated where it was, else by the model."""
    return [p["rms_mm"] if p["simulated"] else p["model_rms_mm"] for p in sensitivity["hold"]["points"]]


def warnings(sensitivity: Mapping[str, Any] | None) -> list[str]:
    """What a person must not do at all, or cannot rely on."""
    if sensitivity is None or "stable" not in sensitivity:
        return []
    if not sensitivity["stable"]:
        return ["UNSTABLE: the part would not stay in this shape, or not in the one that it springs back to."]
    moved = [sensitivity["hold"]["random_rms_mm"], *point_errors(sensitivity)]
    hardly = [HARDLY_STABLE] if None in moved else []
    return (
        hardly
        + _nearly_buckled(sensitivity["softest"])
        + ([DO_NOT_HANG_WEIGHTS] if sensitivity["instability"]["dead_loads"] else [])
    )


def _nearly_buckled(softest: Mapping[str, Any] | None) -> list[str]:
    if softest is None or softest["stiffness_left"] >= NEARLY_BUCKLED:
        return []
    place = ", ".join(number(v, 0) for v in softest["at_mm"])
    return [
        f"NEARLY BUCKLED: held hot, the part keeps {100 * softest['stiffness_left']:.1f} % of its stiffness at rest "
        f"near ({place}) mm of the printed part. Printed or pulled a little otherwise, it may snap to another shape."
    ]


def _force_deviations(force: Mapping[str, Any]) -> list[Deviation]:
    return [
        Deviation(
            f"pads set by force gauge, all forces {100 * force['change']:g} % {way}",
            force[way]["rms_mm"] if force[way]["simulated"] else force[way]["model_rms_mm"],
            force[way]["model_rms_mm"],
        )
        for way in ("smaller", "larger")
    ]


def _modulus_deviations(modulus: Mapping[str, Any], phase: str) -> list[Deviation]:
    share = f"{100 * modulus['change']:g} %"
    return [
        Deviation(f"{PHASES[phase]} {share} {way} than its card says{_force_words(found['forces'])}", found["rms_mm"])
        for way, found in ((way, modulus[phase][way]) for way in ("softer", "stiffer"))
    ]


def _force_words(forces: float | None) -> str:
    """How the size of all forces changes; nothing below half a percent."""
    percent = 0.0 if forces is None else 100 * (forces - 1)
    if abs(percent) < 0.5:
        return ""
    return f" (forces {number(abs(percent), 0)} % {'larger' if percent > 0 else 'smaller'})"


def _direction(vector: list[float]) -> str:
    return " ".join(number(v, 2) for v in vector)
