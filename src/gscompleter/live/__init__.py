"""A scene that is completed while somebody looks at it, camera after camera."""
