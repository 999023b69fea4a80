"""A surveyed map against drives in it: which entries are wrong, since when, and the corrected file."""
