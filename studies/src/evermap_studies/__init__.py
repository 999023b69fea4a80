"""Papers reproduced with evermap, its demonstration, and the peers that it is compared with."""
