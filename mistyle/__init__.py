"""mistyle: one mesh and one style image in, the same mesh with stylized, physically based textures out."""

__version__ = "0.1.0"
