"""Metrics, plots, rig sheet and report page."""
