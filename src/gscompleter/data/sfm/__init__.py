"""Structure from motion: camera poses of photographs that have none."""

NUM_VIDEO_FRAMES = 40
"""Default number of frames that are taken of a video as photographs, at most."""
