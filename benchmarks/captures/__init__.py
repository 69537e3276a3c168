"""Photographs as they come: exposures, unknown skies, clutter, metals, plans."""
