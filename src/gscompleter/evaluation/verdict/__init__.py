"""The verdict on a completion: scores at unused photographs, and what they decide."""
