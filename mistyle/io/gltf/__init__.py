"""glTF 2.0: checked, read, written, and patched in place."""
