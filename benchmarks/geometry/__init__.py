"""Vertices displaced to drawn outlines."""
