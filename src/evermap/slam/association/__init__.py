"""Which detection is which landmark, by geometry alone: for recordings without identities."""
