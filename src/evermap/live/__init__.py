"""A robot that drives: readings in as they come, poses, landmarks and changes out, sessions into the map."""
