"""The joint search over changes of groups of landmarks, with the trajectory marginalised."""
