"""The commands flown when a controller has no usable answer."""
