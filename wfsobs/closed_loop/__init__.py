"""Controllers on the same disturbance: what theory says of them, what a simulation leaves, and rows of both."""
