"""A loop that runs by the clock: sources of frames, and observers that follow them."""
