"""The one test of every answer, and the fallback contract: the commands flown when a law has no usable answer."""
