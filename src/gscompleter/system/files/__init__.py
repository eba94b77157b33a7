"""Images, video, JSON, splats and output folders on the disk."""
