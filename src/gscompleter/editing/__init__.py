"""Changes that a user asks for: objects that are removed from a splat, and floaters."""
