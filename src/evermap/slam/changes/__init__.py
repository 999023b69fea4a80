"""Which landmarks moved together: the joint search over changes, with the trajectory marginalised."""
