"""The door: posed photographs in whatever format a user holds them."""
