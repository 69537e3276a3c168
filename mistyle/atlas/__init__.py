"""Texture space: rasterised UVs, baking (paper 4.1.4), neighbours, gap filling."""
