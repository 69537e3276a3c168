"""Live Mitsuba scenes of users: their parameters, their XML text, drawing."""
