"""The shapes of the sample scenes: meshes, warps, and the catalogue that puts them together."""
