"""Robots of many makes: is an estimate ever worse because sensor and odometry were calibrated in it?"""
