"""Contact: with the table, and of a body with itself."""
