"""Contact: with obstacles, and of a body with itself."""
