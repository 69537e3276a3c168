"""Materials, cameras and scene parameters from pictures: inverse problems without files or jobs."""
