"""Mesh files of plain formats, and the way from a parsed mesh to an asset."""
