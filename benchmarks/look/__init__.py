"""How the embedded stylizer looks: light in the albedo, and the choices of blind viewers."""
