"""The per-texel solver: observations, batched Levenberg–Marquardt, rounds."""
