"""Guides of the synthesis at surface points: tone, colour, detail and stroke direction."""
