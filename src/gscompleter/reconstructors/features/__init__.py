"""Feature matches between photographs, and the depth range they imply."""
