"""Whole jobs, here and at another commit."""
