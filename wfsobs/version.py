"""The version, apart from the public names of `wfsobs`, which import everything."""

__version__ = "0.3.0"
