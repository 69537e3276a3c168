"""Descent on whole pictures: Adam through the deferred renderer and through `prb`."""
