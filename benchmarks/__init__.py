"""Measurements; they print a table and write flat JSON figures. Run one with `python -m benchmarks.NAME`."""
