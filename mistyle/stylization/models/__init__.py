"""Model files of the generative stages: where they lie, checks, fetching, loading."""
