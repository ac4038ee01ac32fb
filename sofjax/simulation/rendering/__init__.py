"""Images of a world, by tracing rays."""
