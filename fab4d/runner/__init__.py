"""Executes the stage table on a run folder: order, files, what is current, resuming. Knows no physics."""
