"""The common parts of all jobs: settings, stage cache, progress, plans, summaries."""
