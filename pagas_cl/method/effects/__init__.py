"""What a view calls for: measured, and decided (method section 8)."""
