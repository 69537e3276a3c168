"""`mistyle compare` and `mistyle converge`: how renders differ, in numbers and pictures."""
