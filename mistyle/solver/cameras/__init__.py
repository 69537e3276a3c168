"""Camera and mesh alignment by silhouettes and shading."""
