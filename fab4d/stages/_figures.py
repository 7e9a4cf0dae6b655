"""The figures of a verified design and the limits of its scene, for the verdict and for the report."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from fab4d.fabrication.labels import isolated_fraction
from fab4d.io.scene import Acceptance, Goal, RigCard
from fab4d.materials.cards import MaterialCard
from fab4d.mesh.measures import bounding_box_diagonal
from fab4d.report import metrics
from fab4d.report.verdict import Limits, default_tolerance


def printed_labels(inputs: Mapping[str, Any]) -> np.ndarray:
    """(m,) bool: what is printed in SMP; nothing where nothing is to be programmed."""
    labels = inputs["labels"]
    return np.zeros(len(inputs["mesh"]["tets"]), bool) if labels is None else labels["smp"].astype(bool)


def limits_of(goal: Goal, acceptance: Acceptance, rig: RigCard, shapes: metrics.Shapes) -> Limits:
    """What the scene asks for."""
    usual = default_tolerance(bounding_box_diagonal(shapes.X), metrics.target_displacement(shapes).rms)
    return Limits(
        tolerance=usual if goal.tolerance is None else goal.tolerance,
        max_forces=rig.max_points if goal.max_forces is None else goal.max_forces,
        max_smp_fraction=goal.max_smp_fraction,
        max_ambiguous_fraction=acceptance.max_ambiguous_fraction,
        max_isolated_fraction=acceptance.max_isolated_fraction,
    )


def figures_of(
    inputs: Mapping[str, Any], materials: MaterialCard, shapes: metrics.Shapes, smp: np.ndarray
) -> dict[str, Any]:
    """The figures of report.json that a verdict hangs on, and those beside them.

    The share of isolated tets is that of the labels smp (m,) that are printed; stage `threshold` has checked the design
    that they come from.
    """
    mesh, threshold, verify = inputs["mesh"], inputs["threshold_report"] or {}, inputs["verify_report"] or {}
    mass, cost = metrics.mass_and_cost(mesh, smp, materials)
    return {
        "error": metrics.error_figures(metrics.final_error(shapes), bounding_box_diagonal(shapes.X)),
        "target_displacement_mm": metrics.target_displacement(shapes).rms,
        "target_projection": inputs["check_report"].get("target_projection"),
        "smp_fraction": metrics.smp_fraction(mesh, smp),
        "forces": metrics.force_count(inputs["state"]),
        "ambiguous_fraction": threshold.get("ambiguous_fraction"),
        "isolated_fraction": isolated_fraction(mesh["tets"], smp) if threshold else None,
        "fixity": metrics.fixity(shapes),
        "undesired_deformation": metrics.undesired_deformation(shapes),
        "equilibrium_residual": verify.get("equilibrium_residual", {"median": None, "final": None}),
        "min_det_F": verify.get("min_det_F"),
        "element_order": verify.get("element_order"),
        "force_change": verify.get("force_change"),
        "force_uncertainty": verify.get("force_uncertainty"),
        "mass_g": mass,
        "cost_usd": cost,
    }
