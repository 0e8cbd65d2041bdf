"""Observers on the streams of a running loop: ImageStreamIO shared memory, read and written without a library."""
