"""Look-dev pictures: turntables, reference balls, AOVs, studio renders."""
