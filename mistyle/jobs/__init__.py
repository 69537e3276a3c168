"""What every job has: settings, stage cache, progress, plans, summaries."""
