"""A whole method, coarsely: for methods that are not five parts and an update rule."""
