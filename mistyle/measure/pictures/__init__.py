"""Metrics between two pictures, as rendering people quote them."""
