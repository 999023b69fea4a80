"""Libraries of other people behind our protocols."""
