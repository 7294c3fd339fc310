"""What is flown when a controller has no good answer."""
