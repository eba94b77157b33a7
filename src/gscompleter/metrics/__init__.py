"""What judges a result, apart from what produces it."""
