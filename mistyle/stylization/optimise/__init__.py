"""Two-phase optimisation of normal and roughness, then albedo (paper 4.2)."""
