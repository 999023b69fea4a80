"""The living map: what stands where, since when, how surely, and how long such things tend to stay."""
