"""The stylization jobs, stage by stage."""
