"""In which frame a user's splat lies, told from the photographs it was trained on."""
