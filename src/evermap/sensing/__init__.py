"""Detection models: the probability that a sensor detects a landmark."""
