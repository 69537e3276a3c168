"""Other renderers behind one call: Cycles, Blender, another Mitsuba."""
