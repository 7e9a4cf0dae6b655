"""Tet meshes as plain arrays: topology, measures, quality. No files, no physics."""
