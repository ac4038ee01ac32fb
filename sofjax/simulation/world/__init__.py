"""Worlds: what stands on a floor, where, and how it looks."""
