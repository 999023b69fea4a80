"""Landmark SLAM in space: tags, objects and points seen by cameras and other sensors, with or without odometry."""
