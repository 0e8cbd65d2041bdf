"""The makers of priors: the only door from the truth, or from an identification, to observers."""
