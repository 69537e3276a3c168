"""Pictures and textures: decoding, colour profiles, encoding, packing."""
