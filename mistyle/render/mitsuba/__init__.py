"""Mitsuba scenes of meshes with maps: plugins, drawing, visibility."""
