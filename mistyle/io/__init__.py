"""Files of every format, read through the sandbox and written atomically."""
