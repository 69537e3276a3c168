"""Weight-free painter: guided patch synthesis on surface samples."""
