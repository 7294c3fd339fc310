"""The one test of every answer, and the fallback contract: what is flown when a controller has no usable answer."""
