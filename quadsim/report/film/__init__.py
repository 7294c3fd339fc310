"""Films of flights: frames, captions and the processes that render them."""
