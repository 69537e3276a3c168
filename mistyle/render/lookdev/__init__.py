"""Look-dev pictures: turntables, reference balls, AOVs, the studio."""
