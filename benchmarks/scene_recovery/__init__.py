"""Parameters of any Mitsuba scene, fitted to its renders."""
