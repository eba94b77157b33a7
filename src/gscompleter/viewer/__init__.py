"""A page that shows a scene before and after its completion, in any browser."""
