"""Trust in the Gaussians of the context, from the photographs."""
