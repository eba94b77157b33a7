"""COLMAP's sparse models: cameras, images and points, as binary and as text files."""
