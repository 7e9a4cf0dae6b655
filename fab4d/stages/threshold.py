"""From the relaxed density to one printable material a tet."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from fab4d.fabrication.labels import (
    LabelResult,
    Lines,
    ambiguous_fraction,
    isolated_fraction,
    printable_labels,
    rounded_labels,
)
from fab4d.fabrication.orientation import standing
from fab4d.io.scene import Acceptance, PrinterCard
from fab4d.mesh.measures import tet_volumes
from fab4d.mesh.tetmesh import BoolArray, FloatArray, IntArray
from fab4d.stages.monitor import Monitor

# The smallest feature that holds its shape: lines across, layers high. Source: fabrication trials with three slicers.
LINES_PER_FEATURE = 2
LAYERS_PER_FEATURE = 2
# A tet that the design is undecided about costs this share of the usual to change; a decided one 0.5 more.
_LEAST_COST = 0.05


def run(inputs: Mapping[str, Any], profile: Mapping[str, Any], monitor: Monitor) -> dict[str, Any]:
    """Round the density, remove what cannot be printed, and judge the design by the two acceptance checks."""
    X, tets = inputs["mesh"]["X"], inputs["mesh"]["tets"]
    rho, cost = inputs["relaxed"]["rho"], inputs["relaxed"]["repair_cost"]
    monitor.progress("clean-up", tets=len(tets))
    labels = labels_for(X, tets, rho, cost, profile["printer"])
    report = _report(X, tets, rho, labels, profile["acceptance"])
    return {"rounded": {"smp": labels.smp, "cluster": labels.cluster}, "threshold_report": report}


def labels_for(X: FloatArray, tets: IntArray, rho: FloatArray, cost: FloatArray, printer: PrinterCard) -> LabelResult:
    """`printable_labels` of the density rho (m,) for a printer.

    cost : (m,) of changing each tet; what the design is sure about costs more
    """
    sure = np.abs(rho - 0.5) + _LEAST_COST
    return printable_labels(standing(X, printer.up), tets, rho, lines_of(printer), flip_cost=sure * cost)


def lines_of(printer: PrinterCard) -> Lines:
    """The lines of a printer and the smallest feature that they make."""
    width, height = printer.line_width, printer.layer_height
    return Lines(width, height, LINES_PER_FEATURE * width, LAYERS_PER_FEATURE * height)


def _report(
    X: FloatArray, tets: IntArray, rho: FloatArray, labels: LabelResult, acceptance: Acceptance
) -> dict[str, Any]:
    volumes = np.abs(tet_volumes(X, tets))
    ambiguous = ambiguous_fraction(rho)
    isolated = isolated_fraction(tets, rounded_labels(rho))
    reasons = acceptance_reasons(ambiguous, isolated, acceptance) + _lost(rho, labels.smp)
    return {
        "ambiguous_fraction": ambiguous,
        "isolated_fraction": isolated,
        "isolated_fraction_printed": isolated_fraction(tets, labels.smp),
        "smp_fraction": float(volumes[labels.smp].sum() / volumes.sum()),
        "clusters": int(labels.cluster.max()),
        "changed_fraction": labels.changed_fraction,
        "feature_mm": list(labels.feature),
        "defects_left": labels.defects_left.tolist(),
        "part_defects": labels.part_defects.tolist(),
        "acceptable": not reasons,
        "reasons": reasons,
    }


def acceptance_reasons(ambiguous: float, isolated: float, acceptance: Acceptance) -> list[str]:
    """What the paper's two acceptance checks say against a design."""
    checks = (
        (ambiguous, acceptance.max_ambiguous_fraction, "of the tets are neither SMP nor TPE (density 0.05 to 0.95)"),
        (isolated, acceptance.max_isolated_fraction, "of the SMP tets touch no other SMP tet"),
    )
    return [
        f"{found:.3%} {what}; fewer than {limit:.3%} are acceptable"
        for found, limit, what in checks
        if found >= limit and found > 0
    ]


def _lost(rho: FloatArray, smp: BoolArray) -> list[str]:
    if rounded_labels(rho).any() and not smp.any():
        return ["all SMP of the design is too small to print: choose a finer nozzle or a larger part"]
    return []
