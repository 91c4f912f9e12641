"""A lab's keys, members and router."""
