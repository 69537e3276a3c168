"""`mistyle fit`: materials and scenes from photographs or renders."""
