"""A session laid over a map that lives on: what stands where it stood, what does not, and what both say together."""
