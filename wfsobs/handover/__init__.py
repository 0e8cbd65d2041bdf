"""A controller's design for programs elsewhere: C99, arrays, python-control."""
