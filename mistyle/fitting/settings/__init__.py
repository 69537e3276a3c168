"""Settings of the fitting jobs."""
