"""A web page that compares a scene before and after completion."""
