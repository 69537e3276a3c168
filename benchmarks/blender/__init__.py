"""Our assets opened in Blender's Cycles."""
