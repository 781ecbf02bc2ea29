"""Which effects a view needs: measured, and decided (method section 8)."""
