"""The two-phase fit on painted objects of known relief."""
