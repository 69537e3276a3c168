"""Blind choices between a fit of unlit views and the painter's own maps."""
