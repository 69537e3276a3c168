"""Exposure, white balance, vignetting and veiling light of photographs, from points that several of them show."""
