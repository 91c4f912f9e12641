"""Contact programs, skills and plans."""
