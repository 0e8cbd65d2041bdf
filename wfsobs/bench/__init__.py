"""Side-by-side timings of the observers: ours and the textbook way (`wfsobs bench`); other libraries are in `benchmarks/`."""
