"""The work of the commands that complete a scene."""
