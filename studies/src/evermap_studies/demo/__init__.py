"""Four weeks in a building where things come and go, lived through with every method: `evermap demo`."""
