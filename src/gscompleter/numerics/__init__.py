"""Mathematics shared by all stages: geometry, image operations, robust fits, Adam, kernels."""
