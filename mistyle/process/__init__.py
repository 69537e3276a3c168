"""The process around the work: memory, threads, signals, child processes, weight files."""
