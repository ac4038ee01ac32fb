"""Corridors, robots that are driven through them, and what their cameras see."""
