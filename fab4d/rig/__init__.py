"""From forces to what a person sets up: patches, directions, schedule."""
