"""Feed-forward models: the authors' weights on our own networks."""
