"""Reports of the fitting jobs."""
