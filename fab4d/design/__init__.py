"""The inverse problem: SMP distribution and forces for a wanted temporary shape."""
