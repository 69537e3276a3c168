"""Finished assets in the formats of other programs, and their verification."""
