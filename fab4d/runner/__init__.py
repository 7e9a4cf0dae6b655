"""Order, artifacts on disk, resuming, leaving out."""
