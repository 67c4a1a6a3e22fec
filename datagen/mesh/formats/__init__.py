"""One file a mesh format, and the surface that they share."""

FORMATS = (".obj", ".ply", ".off", ".glb", ".stl")
