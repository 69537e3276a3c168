"""Exemplar of the style picture: preparation, measures, derived settings and relief."""
