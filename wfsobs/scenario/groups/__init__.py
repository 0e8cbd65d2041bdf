"""The settings of a scenario, one module per topic."""
