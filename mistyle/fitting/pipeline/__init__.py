"""The fitting jobs, stage by stage."""
