"""Finished assets in the files that other programs open, and their verification."""
