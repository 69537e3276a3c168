"""The style reaches the geometry: vertices follow stylized outlines, and the relief becomes a height map."""
