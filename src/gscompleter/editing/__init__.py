"""What a user takes out of a splat: chosen objects, and floaters."""
