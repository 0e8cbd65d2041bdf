"""Controllers: from measurements, a prior and settings of their own to commands. What they are worth is `wfsobs.closed_loop`."""
