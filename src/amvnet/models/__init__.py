"""The three networks, the assertions and AMVNet itself."""
