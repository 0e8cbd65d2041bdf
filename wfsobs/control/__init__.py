"""Controllers in the closed loop: what an observer is worth in nanometres, milliarcseconds and Strehl."""
