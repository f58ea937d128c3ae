"""Parametric triangle meshes of everything that stands or moves in a simulated street."""
