"""Storage on disk: atomic writes, locks, hashes, records, output folders."""
