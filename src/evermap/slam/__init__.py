"""Where the robot is and where the landmarks are: factor graph, calibration and noise of one session."""
