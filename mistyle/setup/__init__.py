"""From a bare Python to a working environment: the virtual environment, its packages, LLVM. Standard library only."""
