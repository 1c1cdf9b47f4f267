"""Surfaces: triangles between key points, for cloths, garments and meshes."""
