"""The networks of AMVNet, and what they compute with."""
