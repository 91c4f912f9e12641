"""Controllers and the trial protocol they plug into."""
