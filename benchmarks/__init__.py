"""The observers beside other libraries (`python -m benchmarks`); `wfsobs bench` has the textbook forms alone."""
