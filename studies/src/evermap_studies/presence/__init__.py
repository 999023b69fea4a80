"""Models of features that come and go, in a room and at a door."""
