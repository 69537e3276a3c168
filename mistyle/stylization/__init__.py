"""Stylization of a mesh's textures: the paper's method, section by section."""
