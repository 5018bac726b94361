"""What is known of the state after all that was done and seen: exact and particle filters."""
