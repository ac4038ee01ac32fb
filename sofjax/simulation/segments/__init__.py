"""Segments of a world as a detector would find them, without images."""
