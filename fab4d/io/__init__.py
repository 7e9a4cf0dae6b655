"""Formats: scenes, cards, meshes, STL, 3MF, VTU."""
