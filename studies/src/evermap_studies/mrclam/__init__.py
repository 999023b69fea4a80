"""All robots of the UTIAS recordings against the truth."""
