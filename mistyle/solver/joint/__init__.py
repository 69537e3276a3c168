"""The joint Gauss–Newton step over all texels and pictures."""
