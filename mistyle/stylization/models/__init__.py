"""Model files of the generative stages: search, checks, download, loading."""
