"""Other ways to complete a scene, for comparison only: nothing of the method depends on them."""
