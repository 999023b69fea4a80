"""The living map: landmarks at their sites with stays, beliefs and lifetimes."""
