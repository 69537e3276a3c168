"""Measurements; they print a table and write flat JSON figures. Run one with `.venv/bin/python -m benchmarks.NAME`."""

from mistyle.setup.environment import use_llvm

# Before any of them imports Dr.Jit, which looks for its LLVM only once.
use_llvm()
