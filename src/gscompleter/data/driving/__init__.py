"""Driving data sets: rigs, poses, lidar and moving objects."""
