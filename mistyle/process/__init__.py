"""Process control: memory, threads, signals, child processes, weight files."""
