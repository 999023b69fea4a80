"""Updates of a living map by a session: alignment, beliefs, decisions and the next map."""
