"""evermap keeps landmark maps true while the world changes."""
