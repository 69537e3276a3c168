"""The two-phase fit's speed, and the ranking of styles without weights."""
