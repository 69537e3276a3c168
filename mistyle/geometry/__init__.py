"""Meshes as geometry: UV unwrapping, tangents, rasterisation, registration, lens models."""
