"""The style picture as the painter sees it."""
