"""Materials fitted to pictures with known truth, beside rivals. Other benchmarks use its pictures and metrics."""
