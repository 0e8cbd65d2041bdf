"""The arena: observers and controllers under the same rules on the same records, and the ranks that come of it."""
