"""Define the numbers of a model and of its training: schema, bounds and recipes."""
