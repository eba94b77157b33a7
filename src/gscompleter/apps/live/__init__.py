"""Interactive completion in the browser, camera after camera."""
