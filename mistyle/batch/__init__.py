"""`mistyle batch`: many jobs on one machine or on a farm."""
