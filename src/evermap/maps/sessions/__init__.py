"""Where maps and sessions meet: a session laid over the living map, and the map that comes out of it."""
