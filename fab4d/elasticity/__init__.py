"""Finite elements and hyperelastic energies: value, gradient, tangent."""
