"""Public glTF and USD models, drawn here and in Cycles."""
