"""What observers are told beside measurements."""
