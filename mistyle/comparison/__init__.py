"""`mistyle compare` and `mistyle converge`: image metrics, error maps and convergence of renders."""
