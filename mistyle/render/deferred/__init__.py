"""The deferred renderer: surface samples traced once, shaded by differentiable kernels."""
