"""Deformation of a mesh to given outlines (paper 6.2.2)."""
