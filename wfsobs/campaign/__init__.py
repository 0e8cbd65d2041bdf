"""Campaigns: many scenarios, seeds, observers and controllers, on many processes or machines."""
